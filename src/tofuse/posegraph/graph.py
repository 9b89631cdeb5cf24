"""The pose graph: where the cameras are, and what was measured between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError
from tofuse.geometry import se3

Float64 = NDArray[np.float64]
Integers = NDArray[np.intp]

EdgeKind = Literal["odometry", "loop"]


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Poses and measured relative poses, in columns.

    Attributes
    ----------
    ids
        (N,) ids of the vertices (frame indices), unique.
    poses
        (N, 4, 4) T_world_vertex.
    edges
        (M, 2) positions in `ids` (not ids) of the ends i, j.
    measurements
        (M, 4, 4) measured T_i_j.
    information
        (M, 6, 6) information of ``log(Z^-1 T_i^-1 T_j)``, order (tx ty tz rx ry rz), SI units.
    loop
        (M,) True for edges that close a loop, False for odometry.
    """

    ids: Integers
    poses: Float64
    edges: Integers
    measurements: Float64
    information: Float64
    loop: NDArray[np.bool_]

    def __post_init__(self) -> None:
        n, m = len(self.ids), len(self.edges)
        shapes = {
            "poses": (n, 4, 4),
            "edges": (m, 2),
            "measurements": (m, 4, 4),
            "information": (m, 6, 6),
            "loop": (m,),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(
                    f"{name} has shape {getattr(self, name).shape}, not {shape}", where="pose graph"
                )
        if m and (self.edges.min() < 0 or self.edges.max() >= n):
            raise InputError("an edge names a vertex that is not there", where="pose graph")

    @classmethod
    def empty(cls) -> PoseGraph:
        """Return a graph with nothing in it."""
        return cls(
            np.zeros(0, np.intp),
            np.zeros((0, 4, 4)),
            np.zeros((0, 2), np.intp),
            np.zeros((0, 4, 4)),
            np.zeros((0, 6, 6)),
            np.zeros(0, bool),
        )

    def with_poses(self, poses: Float64) -> PoseGraph:
        """Return the graph with other poses."""
        return replace(self, poses=poses)

    def residuals(self) -> Float64:
        """Return the (M, 6) errors ``log(Z^-1 T_i^-1 T_j)`` of the edges."""
        i, j = self.edges.T
        T_i_j = se3.inverse(self.poses[i]) @ self.poses[j]
        return se3.log(se3.inverse(self.measurements) @ T_i_j)

    def chi2(self) -> float:
        """Return the sum of squared errors weighted by the information."""
        r = self.residuals()
        return float(np.einsum("mi,mij,mj->", r, self.information, r))


@dataclass(frozen=True, eq=False)
class Optimisation:
    """What an optimiser made of a graph.

    Attributes
    ----------
    graph
        The graph with its new poses; the first vertex has not moved.
    objective
        The method's own objective at the start and after every iteration.
    converged
        Whether the stopping rule was met before the iterations ran out.
    """

    graph: PoseGraph
    objective: tuple[float, ...]
    converged: bool


class Optimiser(Protocol):
    """A method that spreads the error of the loops over the poses."""

    part_kind: ClassVar[str] = "optimiser"

    def optimise(self, graph: PoseGraph) -> Optimisation:
        """Return the graph with better poses; the first vertex stays where it is."""
        ...


@dataclass(frozen=True)
class LoopRecord:
    """A candidate for a loop, and what was decided; `i` < `j` are frame indices.

    `overlap` is the share of points with a partner, `rms_m` their rms distance,
    `free_space_violation` the share of points that one view put where the other saw through
    (None where not computed).
    """

    i: int
    j: int
    accepted: bool
    reason: str
    overlap: float | None = None
    rms_m: float | None = None
    free_space_violation: float | None = None
