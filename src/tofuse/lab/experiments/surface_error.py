"""Errors of a model: accuracy, completeness, F-score (Knapitsch et al. 2017)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import KdTree, triangles

_SAMPLES = 400_000  # points on a mesh
_OUTLIER_M = 0.05
_CANDIDATES = 4  # nearest samples of a mesh whose triangles are tested


@dataclass(frozen=True, eq=False)
class Surface:
    """A point cloud, or with `faces` a mesh.

    Attributes
    ----------
    points
        (N, 3) in m.
    faces
        (M, 3) rows of points, or None.
    """

    points: Float64
    faces: NDArray[np.integer] | None = None

    def __post_init__(self) -> None:
        points = np.asarray(self.points, float)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InputError(
                f"has shape {points.shape}, or numbers that are not finite",
                where="points of a model",
                remedy="pass (N, 3) finite numbers in metres",
            )
        object.__setattr__(self, "points", points)

    @property
    def area(self) -> float:
        """Area of all faces, m^2; 0 for a cloud."""
        if self.faces is None:
            return 0.0
        return float(triangles.areas(self.points[self.faces]).sum())

    def samples(self, count: int, seed: int = 0) -> tuple[Float64, Int64]:
        """Return points (K, 3) spread evenly over the faces, and their faces (K,).

        For a cloud, at most `count` of its own points, chosen at random, and -1.
        """
        if self.faces is None or len(self.faces) == 0:
            points = self.points
            if len(points) > count:
                rng = np.random.default_rng([seed, len(points)])
                points = points[np.sort(rng.permutation(len(points))[:count])]
            return points, np.full(len(points), -1)
        corners = self.points[self.faces]
        cumulative = np.cumsum(triangles.areas(corners))
        if not cumulative[-1] > 0:
            return self.points, np.full(len(self.points), -1)
        rng = np.random.default_rng([seed, len(corners)])
        # Stratified sampling: one point in each of `count` equal parts of the area.
        at = (np.arange(count) + rng.random(count)) / count * cumulative[-1]
        face = np.minimum(np.searchsorted(cumulative, at, side="right"), len(corners) - 1)
        return triangles.points_in(corners[face], rng), face


@dataclass(frozen=True)
class SurfaceErrors:
    """Distances in m between a model and a reference.

    Attributes
    ----------
    accuracy_m, accuracy_median_m, accuracy_p95_m
        Mean, median and 95th percentile of the distance from the model to the reference, over its
        points or evenly over its faces.
    completeness_m
        Mean distance from the reference to the model.
    precision, recall, fscore
        Fraction of the model within `threshold_m` of the reference, of the reference within
        `threshold_m` of the model, and their harmonic mean.
    outliers
        Fraction of the model farther than 5 cm from the reference.
    threshold_m
        The limit, m.
    """

    accuracy_m: float
    accuracy_median_m: float
    accuracy_p95_m: float
    completeness_m: float
    precision: float
    recall: float
    fscore: float
    outliers: float
    threshold_m: float


def compare_surfaces(
    model: Surface,
    reference: Surface,
    *,
    threshold_m: float = 0.01,
    visible: ArrayLike | None = None,
    samples: int = _SAMPLES,
) -> SurfaceErrors:
    """Compare a model with a reference in the same frame.

    Parameters
    ----------
    model, reference
        Meshes or clouds. Distances to a mesh are those to its triangles.
    threshold_m
        Maximum distance of an inlier, m.
    visible
        (K, 3) visible points of the reference, the only ones that completeness counts; by default
        the entire reference.
    samples
        Number of points that represent a mesh.

    Raises
    ------
    InputError
        If one of them is empty.
    """
    for name, shape in (("model", model), ("reference", reference)):
        if len(shape.points) == 0:
            raise InputError("is empty", where=name, remedy="pass a model with points")
    points, _ = model.samples(samples, seed=1)
    model_distances = distances(points, reference, samples)
    reference_points = (
        reference.samples(samples, seed=2)[0] if visible is None else np.asarray(visible, float)
    )
    reference_distances = distances(reference_points, model, samples)
    precision = float((model_distances <= threshold_m).mean())
    recall = float((reference_distances <= threshold_m).mean())
    total = precision + recall
    return SurfaceErrors(
        float(model_distances.mean()),
        float(np.median(model_distances)),
        float(np.percentile(model_distances, 95)),
        float(reference_distances.mean()),
        precision,
        recall,
        2 * precision * recall / total if total else 0.0,
        float((model_distances > _OUTLIER_M).mean()),
        threshold_m,
    )


def distances(points: ArrayLike, shape: Surface, samples: int = _SAMPLES) -> Float64:
    """Return distances (K,) in m from points (K, 3) to a cloud's points or a mesh's triangles.

    For a mesh, the distance to the nearest of the triangles of the 4 nearest samples: never too
    small, but possibly too large where samples are sparse.

    Parameters
    ----------
    points
        (K, 3), m.
    shape
        The cloud or mesh.
    samples
        Number of points that represent a mesh.
    """
    points = np.asarray(points, float)
    sampled, face = shape.samples(samples)
    tree = KdTree(sampled)
    if shape.faces is None or (len(face) and face[0] < 0):
        return np.sqrt(tree.nearest(points)[1])
    corners = shape.points[shape.faces]
    nearest, _ = tree.neighbours(points, min(_CANDIDATES, len(sampled)))
    best = np.full(len(points), np.inf)
    for column in nearest.T:
        foot = triangles.closest_points(points, corners[face[column]])
        best = np.minimum(best, np.linalg.norm(points - foot, axis=1))
    return best
