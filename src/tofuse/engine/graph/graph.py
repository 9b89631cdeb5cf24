"""The pose graph: poses of the cameras, and measurements of their relative poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.alignment import Registration
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.graph import robust

# Squared error of an edge, in units of its information, up to which it may be rounding.
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Gravity:
    """Directions of gravity measured at single poses: weighted edges to the world's vertical.

    Attributes
    ----------
    vertices
        (g,) positions of the poses.
    directions
        (g, 3) unit vectors, each in the frame of its camera.
    sigma
        (g,) standard deviation of each, rad.
    gate
        Squared error, in units of sigma, beyond which a direction has little weight (Geman and
        McClure), as a moving accelerometer measures more than gravity.
    """

    vertices: Intp
    directions: Float64
    sigma: Float64
    gate: float

    def vertical(self, observed: Float64) -> Float64:
        """Return the (3,) robust mean of directions (g, 3) observed in the world."""
        weight = 1 / self.sigma**2
        down = np.median(observed, axis=0)  # robust to outliers
        for _ in range(10):
            down = down / max(float(np.linalg.norm(down)), 1e-12)
            x = ((observed - down) ** 2).sum(1) * weight
            down = (observed * (weight * robust.weight("huber", x, 1.0))[:, None]).sum(0)
        return np.asarray(down, np.float64)


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Poses and measured relative poses, as arrays.

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
    gravity
        Measurements of single poses, or None. g2o files don't contain them.
    """

    ids: Intp
    poses: Float64
    edges: Intp
    measurements: Float64
    information: Float64
    loop: Bool
    gravity: Gravity | None = None

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
        if self.gravity is not None and not np.isin(self.gravity.vertices, np.arange(n)).all():
            raise InputError("a direction of gravity names no vertex", where="pose graph")
        if m and (self.edges.min() < 0 or self.edges.max() >= n):
            raise InputError("an edge names a vertex that is not there", where="pose graph")
        if m and (self.edges[:, 0] == self.edges[:, 1]).any():
            raise InputError("an edge joins a vertex to itself", where="pose graph")

    def __repr__(self) -> str:
        return (
            f"PoseGraph: {quantities.count(len(self.ids), 'pose')}, "
            f"{quantities.count(len(self.edges), 'edge')} "
            f"({quantities.count(int(self.loop.sum()), 'loop')})"
        )

    @classmethod
    def empty(cls) -> PoseGraph:
        """Return a graph without vertices."""
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

    def with_edges(self, measured: Sequence[Measured]) -> PoseGraph:
        """Return the graph with further edges, which close no loops."""
        if not measured:
            return self
        row = {int(index): k for k, index in enumerate(self.ids)}
        pairs: Intp = np.array([(row[m.i], row[m.j]) for m in measured], np.intp)
        return replace(
            self,
            edges=np.concatenate([self.edges, pairs]),
            measurements=np.concatenate([self.measurements, [m.T_i_j for m in measured]]),
            information=np.concatenate([self.information, [m.information for m in measured]]),
            loop=np.concatenate([self.loop, np.zeros(len(measured), bool)]),
        )

    def subgraph(self, vertices: Intp, edges: Intp) -> PoseGraph:
        """Return the subgraph of vertices, and of edges between them.

        Parameters
        ----------
        vertices, edges
            Their positions, ascending.
        """
        number = np.full(len(self.ids), -1)
        number[vertices] = np.arange(len(vertices))
        gravity = self.gravity
        if gravity is not None:
            kept = number[gravity.vertices] >= 0
            gravity = replace(
                gravity,
                vertices=number[gravity.vertices[kept]],
                directions=gravity.directions[kept],
                sigma=gravity.sigma[kept],
            )
        return PoseGraph(
            self.ids[vertices],
            self.poses[vertices],
            number[self.edges[edges]],
            self.measurements[edges],
            self.information[edges],
            self.loop[edges],
            gravity if gravity is not None and len(gravity.vertices) else None,
        )

    def residuals(self) -> Float64:
        """Return the (M, 6) errors ``log(Z^-1 T_i^-1 T_j)`` of the edges."""
        i, j = self.edges.T
        T_i_j = se3.inverse(self.poses[i]) @ self.poses[j]
        return se3.log(se3.inverse(self.measurements) @ T_i_j)

    def squared_errors(self) -> Float64:
        """Return the (M,) squared errors of the edges, weighted by their information."""
        r = self.residuals()
        return np.asarray(np.einsum("mi,mij,mj->m", r, self.information, r), np.float64)

    def chi2(self, edges: Bool | None = None) -> float:
        """Return the sum of the squared errors of all edges or some."""
        squared_errors = self.squared_errors()
        return float(squared_errors.sum() if edges is None else squared_errors[edges].sum())


@dataclass(frozen=True)
class GraphPart:
    """A connected part of the graph, optimised separately.

    Attributes
    ----------
    first
        Id of its first vertex, which is fixed.
    vertices, edges
        Their numbers.
    before, after
        The method's objective. If it could not be lowered they are equal, and the poses are those
        of the input.
    converged
        Whether the stopping rule was met.
    """

    first: int
    vertices: int
    edges: int
    before: float
    after: float
    converged: bool

    @property
    def improved(self) -> bool:
        """Whether the objective is lower than that of the input."""
        return self.after < self.before


@dataclass(frozen=True, eq=False)
class Optimisation:
    """The result of an optimiser.

    Attributes
    ----------
    graph
        The graph with optimised poses; the first vertex is fixed.
    objective
        The method's own objective at the start and after every iteration.
    converged
        Whether the stopping rule was met within the iterations.
    weights
        (M,) final weight of each edge's information, 0 for rejected edges; None if the method is
        not robust.
    parts
        The connected parts of the graph, if the method distinguishes them.
    """

    graph: PoseGraph
    objective: tuple[float, ...]
    converged: bool
    weights: Float64 | None = None
    parts: tuple[GraphPart, ...] = ()

    @property
    def improved(self) -> bool:
        """Whether the method's objective is lower than that of the input."""
        if self.parts:
            return any(part.improved for part in self.parts)
        return len(self.objective) > 1 and self.objective[-1] < self.objective[0]


class Optimiser(Protocol):
    """A method that distributes the error of the loops over the poses."""

    part_kind: ClassVar[str] = "optimiser"

    def optimise(self, graph: PoseGraph) -> Optimisation:
        """Return the graph with optimised poses; the first vertex is fixed."""
        ...


@dataclass(frozen=True)
class LoopRecord:
    """A candidate for a loop closure, and the decision about it; None where not computed.

    Attributes
    ----------
    i, j
        Frame indices, i < j.
    accepted
        Whether it is in the pose graph.
    reason
        Reason of the decision; may be empty.
    overlap
        Fraction of points with a correspondence, 0 to 1.
    rms_m
        Rms distance of the correspondences, m.
    free_space_violation
        Fraction of points of one view in the free space of the other, 0 to 1.
    margin
        Lead of the pose found by a search over its best rival, as a fraction of the points.
    """

    i: int
    j: int
    accepted: bool
    reason: str
    overlap: float | None = None
    rms_m: float | None = None
    free_space_violation: float | None = None
    margin: float | None = None

    @classmethod
    def of(
        cls, pair: tuple[int, int], accepted: bool, reason: str, registration: Registration
    ) -> LoopRecord:
        """Return the decision on a registration of two views.

        Parameters
        ----------
        pair
            Indices (i, j) of their frames.
        accepted, reason
            The decision, and why.
        registration
            The registration.
        """
        return cls(
            *pair,
            accepted,
            reason,
            overlap=registration.overlap,
            rms_m=registration.rms_m if np.isfinite(registration.rms_m) else None,
            free_space_violation=registration.violation,
            margin=registration.margin,
        )


@dataclass(frozen=True, eq=False)
class Measured:
    """One measurement between frames i and j: T_i_j and its (6, 6) information."""

    i: int
    j: int
    T_i_j: Float64
    information: Float64


def build_graph(
    ids: Sequence[int], poses: Float64, sequence: Sequence[Measured], loops: Sequence[Measured] = ()
) -> PoseGraph:
    """Build the graph of posed frames and of the measurements between them.

    Parameters
    ----------
    ids
        Indices of the N frames that have a pose.
    poses
        (N, 4, 4) T_world_camera.
    sequence, loops
        Odometry edges, and loop edges; both may be empty.

    Raises
    ------
    InputError
        If an edge names a frame that has no pose.
    """
    position = {int(index): k for k, index in enumerate(ids)}
    edges = [*sequence, *loops]
    for edge in edges:
        for index in (edge.i, edge.j):
            if index not in position:
                raise InputError(
                    f"the edge {edge.i} {edge.j} names frame {index}, which has no pose",
                    where="pose graph",
                )
    m = len(edges)
    return PoseGraph(
        ids=np.array(ids, np.intp),
        poses=np.asarray(poses, float).reshape(-1, 4, 4),
        edges=np.array([(position[e.i], position[e.j]) for e in edges], np.intp).reshape(m, 2),
        measurements=np.array([e.T_i_j for e in edges], float).reshape(m, 4, 4),
        information=np.array([e.information for e in edges], float).reshape(m, 6, 6),
        loop=np.arange(m) >= len(sequence),
    )
