"""Appearance-based place recognition with small images, compared at several shifts.

The descriptor of a view is a small image of log depth and log albedo. Two views are similar if
their descriptors differ little at some relative shift, which approximates a small rotation of the
camera. No pose is needed.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from tofuse.engine.arrays import Float32, Float64, Intp
from tofuse.engine.compute import run_chunks
from tofuse.engine.views.prepared_view import PreparedView

_ROWS, _COLUMNS = 9, 12
_CHUNKS = 16
# Limits of the differences of the logarithms.
_MAX_DEPTH, _MAX_ALBEDO = 0.3, 0.5
# Minimum fraction of cells with albedo in both views, below which it is not compared.
_MIN_ALBEDO_FRACTION = 0.2
# Of the index of descriptors: principal components, and nearest neighbours per query.
_COMPONENTS, _NEAREST = 8, 6
# Descriptors that are compared with one cell by cell, and shifts at which each of them is.
_COMPARED, _COMPARED_SHIFTS = 256, 8


def view_descriptor(view: PreparedView) -> Float32:
    """Return the descriptor (2, 9, 12): mean log depth and log albedo per cell, NaN if unknown."""
    rows, columns = view.z.shape
    i = np.arange(rows) * _ROWS // rows
    j = np.arange(columns) * _COLUMNS // columns
    cell = (i[:, None] * _COLUMNS + j).ravel()
    size = _ROWS * _COLUMNS
    min_count = np.bincount(cell, minlength=size) / 3
    descriptor = np.full((2, size), np.nan, np.float32)
    depth = np.log(np.where(view.z > 0, view.z, np.float32(np.nan)))
    for image, out in ((depth, descriptor[0]), (view.albedo[..., 0], descriptor[1])):
        valid = np.isfinite(image).ravel()
        count = np.bincount(cell[valid], minlength=size)
        total = np.bincount(cell[valid], image.ravel()[valid].astype(float), minlength=size)
        enough = (count > min_count) & (count > 0)
        out[enough] = total[enough] / count[enough]
    return descriptor.reshape(2, _ROWS, _COLUMNS)


def dissimilarity(descriptor: Float32, others: Float32, shift: float) -> Float64:
    """Return the distances (N,) between one descriptor and others, each at its best shift.

    0 for the same image, 1 for no similarity. The mean difference of log albedo is exposure, and
    ignored. Views without albedo in both are compared by depth alone.

    Parameters
    ----------
    descriptor, others
        Descriptors (2, 9, 12) and (N, 2, 9, 12).
    shift
        Largest shift, as a fraction of the width.
    """
    best = np.ones(len(others))
    for v, u in _shifts(shift):
        np.minimum(best, _at_shift(descriptor, others, v, u), out=best)
    return best


def _shifts(shift: float) -> list[tuple[int, int]]:
    """Return all shifts by v rows and u columns."""
    max_u, max_v = round(shift * _COLUMNS), round(shift * _ROWS / 2)
    return list(itertools.product(range(-max_v, max_v + 1), range(-max_u, max_u + 1)))


def _at_shift(
    descriptor: Float32, others: Float32, v: int, u: int, *, exposed_alike: bool = False
) -> Float64:
    """Return the distances (N,) of descriptors, see `dissimilarity`, at one shift.

    `exposed_alike`: the exposure may be the same; half the weight is on albedo as it is.
    """
    patch = descriptor[:, max(v, 0) : _ROWS + v, max(u, 0) : _COLUMNS + u]
    other_patches = others[:, :, max(-v, 0) : _ROWS - v, max(-u, 0) : _COLUMNS - u]
    return _difference(patch, other_patches, exposed_alike)


def mutual_dissimilarity(descriptors: Sequence[Float32] | Float32, shift: float) -> Float64:
    """Return the pairwise distances (N, N) of descriptors (N, 2, 9, 12), see `dissimilarity`."""
    stack = np.asarray(descriptors)
    distances = np.ones((len(stack), len(stack)))
    i, j = np.triu_indices(len(stack))
    distances[i, j] = pairwise_dissimilarity(stack, i, j, shift)
    return np.minimum(distances, distances.T)


def pairwise_dissimilarity(descriptors: Float32, i: Intp, j: Intp, shift: float) -> Float64:
    """Return the distances (M,) of the pairs i, j of descriptors, see `dissimilarity`."""
    distances = np.ones(len(i))
    order = np.argsort(i, kind="stable")
    unique, begin = np.unique(i[order], return_index=True)
    end = np.append(begin[1:], len(order))

    def work(a: int, b: int) -> None:
        for k in range(a, b):
            rows = order[begin[k] : end[k]]
            distances[rows] = dissimilarity(descriptors[unique[k]], descriptors[j[rows]], shift)

    run_chunks(work, len(unique), _CHUNKS)
    return distances


def similar_views(descriptors: Float32, shift: float) -> tuple[Intp, Intp]:
    """Return candidate pairs i < j of similar descriptors (N, 2, 9, 12), a few for each view.

    A kd-tree over the first principal components of blocks of cells is queried for each view at
    each shift (see `dissimilarity`). Callers compare the candidates cell by cell. Consecutive views
    are excluded, as these are always similar.
    """
    n = len(descriptors)
    described = _blocks(descriptors)
    mean = described.mean(0)
    _, _, axes = np.linalg.svd(described - mean, full_matrices=False)
    axes = axes[:_COMPONENTS]
    tree = cKDTree((described - mean) @ axes.T)
    queried, matched = [], []
    for v, u in _shifts(shift):
        query = (_blocks(_shifted(descriptors, v, u)) - mean) @ axes.T
        _, neighbours = tree.query(query, k=min(_NEAREST, n))
        queried.append(np.repeat(np.arange(n), neighbours.shape[1]))
        matched.append(neighbours.ravel())
    a, b = np.concatenate(queried), np.concatenate(matched)
    i, j = np.minimum(a, b), np.maximum(a, b)
    nonconsecutive = j > i + 1
    i, j = np.divmod(np.unique(i[nonconsecutive] * n + j[nonconsecutive]), n)
    return i, j


class DescriptorIndex:
    """Finds the most similar ones of many descriptors (N, 2, 9, 12).

    Those whose means over blocks of cells are nearest are compared cell by cell, at the shifts at
    which they are.
    """

    def __init__(self, descriptors: Float32) -> None:
        self._descriptors, self._blocks = descriptors, _blocks(descriptors)

    def most_similar(self, descriptor: Float32, shift: float) -> Intp:
        """Return the positions of the most similar ones, these first; see `dissimilarity`."""
        shifts = _shifts(shift)
        shifted = np.concatenate([_shifted(descriptor[None], v, u) for v, u in shifts])
        query = _blocks(shifted, self._blocks.mean(0))
        # Squared distances (shifts, N), but for a term of the descriptors.
        distance = (query**2).sum(1)[:, None] - 2 * query @ self._blocks.T
        nearest = (distance.min(0) + (self._blocks**2).sum(1)).argsort(kind="stable")[:_COMPARED]
        distance = distance[:, nearest]
        k = min(_COMPARED_SHIFTS, len(shifts)) - 1
        is_compared = distance <= np.partition(distance, k, axis=0)[k]
        difference = np.ones(len(nearest))
        for (v, u), compared in zip(shifts, is_compared, strict=True):
            rows = np.flatnonzero(compared)
            others = self._descriptors[nearest[rows]]
            found = _at_shift(descriptor, others, v, u, exposed_alike=True)
            difference[rows] = np.minimum(difference[rows], found)
        return np.asarray(nearest[difference.argsort(kind="stable")])


def _shifted(descriptors: Float32, v: int, u: int) -> Float32:
    """Return descriptors shifted by v rows and u columns."""
    shifted = np.full_like(descriptors, np.nan)
    to_rows, from_rows = slice(max(-v, 0), _ROWS - max(v, 0)), slice(max(v, 0), _ROWS + min(v, 0))
    to_columns = slice(max(-u, 0), _COLUMNS - max(u, 0))
    from_columns = slice(max(u, 0), _COLUMNS + min(u, 0))
    shifted[:, :, to_rows, to_columns] = descriptors[:, :, from_rows, from_columns]
    return shifted


def _blocks(descriptors: Float32, unknown: Float64 | None = None) -> Float64:
    """Return means (N, 24) over blocks of 3 x 3 cells; log albedo is relative to the view's mean.

    Unknown blocks get the values `unknown` (24,), or the mean of all views.
    """
    cells = descriptors.reshape(len(descriptors), 2, _ROWS // 3, 3, _COLUMNS // 3, 3).astype(float)
    valid = np.isfinite(cells)
    count = valid.sum((3, 5))
    total = np.where(valid, cells, 0).sum((3, 5))
    # Scaled by the limits of the differences.
    means = total / np.maximum(count, 1) / np.array([_MAX_DEPTH, _MAX_ALBEDO])[:, None, None]
    has_value = count > 0
    view_mean = np.where(has_value, means, 0).sum((2, 3)) / np.maximum(has_value.sum((2, 3)), 1)
    means[:, 1] -= view_mean[:, 1, None, None]
    if unknown is None:
        overall_mean = np.where(has_value, means, 0).sum(0) / np.maximum(has_value.sum(0), 1)
    else:
        overall_mean = unknown.reshape(means.shape[1:])
    return np.where(has_value, means, overall_mean).reshape(len(descriptors), -1)


def _difference(patch: Float32, others: Float32, exposed_alike: bool) -> Float64:
    """Return the mean differences (N,) of the cells, relative to their limits."""
    difference = others - patch
    valid = np.isfinite(difference)
    count = valid.sum((2, 3))
    difference = np.where(valid, difference, 0)
    exposure = difference[:, 1].sum((1, 2)) / np.maximum(count[:, 1], 1)
    depth = np.minimum(np.abs(difference[:, 0]) / _MAX_DEPTH, 1)
    albedo = np.minimum(np.abs(difference[:, 1] - exposure[:, None, None]) / _MAX_ALBEDO, 1)
    if exposed_alike:
        albedo = 0.5 * (albedo + np.minimum(np.abs(difference[:, 1]) / _MAX_ALBEDO, 1))
    cells = patch[0].size
    depth_distance = (depth.sum((1, 2)) + cells - count[:, 0]) / cells
    # Albedo is known for smooth surfaces only; other cells are ignored.
    albedo_distance = np.where(valid[:, 1], albedo, 0).sum((1, 2)) / np.maximum(count[:, 1], 1)
    has_albedo = count[:, 1] > _MIN_ALBEDO_FRACTION * cells
    return np.asarray(
        np.where(has_albedo, 0.5 * (depth_distance + albedo_distance), depth_distance), np.float64
    )
