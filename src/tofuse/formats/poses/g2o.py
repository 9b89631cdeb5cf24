"""Pose graphs in g2o text files: VERTEX_SE3:QUAT and EDGE_SE3:QUAT.

A vertex is ``id tx ty tz qx qy qz qw``; an edge is ``i j`` and the measured T_i_j in the same
form, then the 21 numbers of the upper triangle of the information matrix, row by row, in the
order (tx ty tz rx ry rz). Its rotation part is read as of the rotation vector in radians, as GTSAM
does (g2o itself refers to the quaternion's vector part, half as large).
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError, InputWarning
from tofuse.engine.geometry import quaternion
from tofuse.engine.graph import PoseGraph
from tofuse.formats.files import atomic, reading

VERTEX = "VERTEX_SE3:QUAT"
EDGE = "EDGE_SE3:QUAT"
# FIX fixes a vertex, which here is always the first; the offset concerns other edges only.
IGNORED = ("FIX", "PARAMS_SE3OFFSET")

_UPPER = np.triu_indices(6)
# Negative eigenvalue, relative to the largest: of computed information, and of information in files
# with few digits.
_ROUNDING, _MAX_NEGATIVE = 1e-9, 1e-2
_UNIT = 1e-2  # tolerance of a quaternion's length, for files with few digits


def read_g2o(path: str | Path) -> PoseGraph:
    """Read a pose graph; vertices and edges keep the order of the file.

    An edge between consecutive vertices of the file is odometry, any other a loop. Lines that start
    with FIX, PARAMS_SE3OFFSET or # are skipped.

    Raises
    ------
    InputError
        If the file can't be read or contains no vertex, and, with the line's number: for an unknown
        tag, a wrong count of numbers, a number that is not finite, a quaternion that is not a
        unit, information that is not positive semidefinite (or is all zero), a duplicate vertex,
        an edge to a missing vertex or from a vertex to itself.

    Warns
    -----
    InputWarning
        If information is not positive semidefinite as its numbers were rounded. The nearest matrix
        that is replaces it; the warning says how many there are.
    """
    lines = reading.read_text(path).splitlines()
    position: dict[int, int] = {}
    vertices: list[list[float]] = []
    ends: list[tuple[int, int]] = []
    edges: list[list[float]] = []
    edge_lines: list[int] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#") or words[0] in IGNORED:
            continue
        with reading.about(f"{path}, line {number}"):
            if words[0] == VERTEX:
                (vertex,), values = _numbers(words, 1, 7)
                if vertex in position:
                    raise InputError(f"vertex {vertex} is given twice")
                position[vertex] = len(vertices)
                vertices.append(values)
            elif words[0] == EDGE:
                (i, j), values = _numbers(words, 2, 28)
                if i == j:
                    raise InputError(f"an edge joins vertex {i} to itself")
                ends.append((i, j))
                edges.append(values)
                edge_lines.append(number)
            else:
                raise InputError(f"holds {words[0]!r}", remedy=f"only {VERTEX} and {EDGE} are read")
    if not vertices:
        raise InputError("contains no vertex", where=path, remedy=f"use {VERTEX} lines")
    for (i, j), number in zip(ends, edge_lines, strict=True):
        for vertex in (i, j):
            if vertex not in position:
                raise InputError(
                    f"the edge {i} {j} names vertex {vertex}, which is not there",
                    where=f"{path}, line {number}",
                )
    rows = np.array(edges, float).reshape(-1, 28)
    information = np.zeros((len(rows), 6, 6))
    information[:, _UPPER[0], _UPPER[1]] = rows[:, 7:]
    information[:, _UPPER[1], _UPPER[0]] = rows[:, 7:]
    information = _projected(information, path, edge_lines)
    pairs = np.array([(position[i], position[j]) for i, j in ends], np.intp).reshape(-1, 2)
    return PoseGraph(
        ids=np.array(list(position), np.intp),
        poses=_poses(np.array(vertices)),
        edges=pairs,
        measurements=_poses(rows),
        information=information,
        loop=np.abs(pairs[:, 1] - pairs[:, 0]) != 1,
    )


def write_g2o(path: str | Path, graph: PoseGraph) -> None:
    """Write a pose graph with all digits of every number; equal graphs give equal bytes.

    Raises
    ------
    InputError
        If a number of the graph is not finite, or its information not positive semidefinite.
    OutputError
        If the file can't be written.
    """
    for name in ("poses", "measurements", "information"):
        if not np.isfinite(getattr(graph, name)).all():
            raise InputError(f"{name} are not all finite", where="pose graph")
    _check_information(graph.information, _ROUNDING, None, None)
    upper = graph.information[:, _UPPER[0], _UPPER[1]]
    values = np.concatenate([_vectors(graph.measurements), upper], axis=1)
    vertices = zip(graph.ids, _vectors(graph.poses), strict=True)
    edges = zip(graph.ids[graph.edges], values, strict=True)
    with (
        atomic.replacing(path) as temporary,
        temporary.open("w", encoding="ascii", newline="\n") as file,
    ):
        file.writelines(f"{VERTEX} {vertex} {_text(row)}\n" for vertex, row in vertices)
        file.writelines(f"{EDGE} {i} {j} {_text(row)}\n" for (i, j), row in edges)


def _numbers(words: list[str], ids: int, count: int) -> tuple[list[int], list[float]]:
    if len(words) != 1 + ids + count:
        raise InputError(
            f"{words[0]} has {quantities.count(len(words) - 1, 'number')}, not {ids + count}",
            remedy="write the whole line",
        )
    try:
        vertices = [int(word) for word in words[1 : 1 + ids]]
        values = [float(word) for word in words[1 + ids :]]
    except ValueError as error:
        raise InputError(f"contains a value that is not a number ({error})") from error
    if not np.isfinite(values).all():
        raise InputError(f"{words[0]} contains a number that is not finite")
    length = float(quaternion.length(values[3:7]))
    if abs(length - 1) > _UNIT:
        raise InputError(f"the quaternion has length {length:.4g}, not 1", remedy="normalise it")
    return vertices, values


def _projected(information: Float64, path: str | Path, line_numbers: list[int]) -> Float64:
    """Replace matrices (m, 6, 6) that are indefinite by rounding by the nearest that are not."""
    _check_information(information, _MAX_NEGATIVE, path, line_numbers)
    values, vectors = np.linalg.eigh(information)
    rounded = values[:, 0] < -_ROUNDING * values[:, -1]
    count = int(rounded.sum())
    if count:
        root = vectors[rounded] * np.sqrt(np.maximum(values[rounded], 0))[:, None, :]
        projected = root @ np.swapaxes(root, 1, 2)
        information[rounded] = (projected + np.swapaxes(projected, 1, 2)) / 2
        warnings.warn(
            f"{path}: {count} of {len(information)} information matrices "
            f"{'is' if count == 1 else 'are'} slightly indefinite, as if rounded; the nearest "
            f"positive semidefinite ones are used",
            InputWarning,
            stacklevel=3,
        )
    return information


def _check_information(
    information: Float64, tolerance: float, path: str | Path | None, line_numbers: list[int] | None
) -> None:
    """Raise InputError for a matrix that is zero or has a negative eigenvalue.

    Eigenvalues may be negative by the tolerance times the largest one; the diagonal may not.
    """
    eigenvalues = np.linalg.eigvalsh(information)
    largest = np.abs(eigenvalues).max(axis=1, initial=0)
    smallest = eigenvalues.min(axis=1, initial=0)
    diagonal = np.diagonal(information, axis1=1, axis2=2).min(axis=1, initial=0)
    bad = np.flatnonzero(
        (smallest < -tolerance * largest) | (diagonal < -_ROUNDING * largest) | (largest == 0)
    )
    if len(bad):
        place = f"edge {bad[0]}" if line_numbers is None else f"{path}, line {line_numbers[bad[0]]}"
        raise InputError(
            "the information matrix is not positive",
            where=place,
            remedy="use the 21 numbers of its upper triangle, row by row, with none negative "
            "along the diagonal",
        )


def _poses(values: Float64) -> Float64:
    return quaternion.to_pose(values[:, 3:7], values[:, :3])


def _vectors(T: Float64) -> Float64:
    return np.concatenate([T[:, :3, 3], quaternion.from_matrix(T[:, :3, :3])], axis=1)


def _text(values: Float64) -> str:
    # Adding zero turns -0.0 into 0.0; repr gives the shortest text that reads back exactly.
    return " ".join(repr(float(value) + 0.0) for value in values)
