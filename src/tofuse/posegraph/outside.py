"""What other sensors than the camera say of its poses, as weighted edges of the graph.

They are weighed by how well they agree with what was tracked, in units of both their errors: an
accelerometer that is moved measures more than gravity, wheels slip, and a file may be of another
camera or in other axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar, Protocol

import numpy as np

from tofuse.arrays import Float64, Intp
from tofuse.geometry import se3
from tofuse.parts import part
from tofuse.posegraph.build import Measured
from tofuse.posegraph.descent import vertical
from tofuse.posegraph.graph import Gravity, PoseGraph

_MEDIAN = 5.3481  # of a chi-square variable with six degrees of freedom


@dataclass(frozen=True, eq=False)
class Sensed:
    """What a recording holds of frames with a pose, beside their views.

    Attributes
    ----------
    ids
        (N,) indices of the frames, ascending.
    odometry
        (N, 4, 4) T_odometry_camera, NaN where there is none.
    gravity
        (N, 4) direction in which things fall in the camera's frame and its sigma in rad, NaN
        where there is none.
    parts
        (N,) number of the recording, of several joined ones: each has its own odometry.
    """

    ids: Intp
    odometry: Float64
    gravity: Float64
    parts: Intp


@dataclass(frozen=True)
class OutsideRecord:
    """What became of a sensor: how many measurements there were and were used, and in words.

    `scale` is how many times its stated errors were taken, None where they are taken as stated.
    """

    sensor: str
    measured: int
    used: int
    scale: float | None
    text: str


@dataclass(frozen=True, eq=False)
class Told:
    """What sensors say of the poses, in frame indices.

    Attributes
    ----------
    steps
        Relative poses of frames in a row, with their information.
    ids
        Frames of which the direction of gravity is known.
    gravity
        (K, 4) as in `Sensed`; the sigmas are not those of the recording alone.
    gate
        See `Gravity.gate`.
    records
        For people, one for each sensor.
    """

    steps: tuple[Measured, ...] = ()
    ids: tuple[int, ...] = ()
    gravity: Float64 | None = None
    gate: float = np.inf
    records: tuple[OutsideRecord, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.steps or self.ids)

    def joined(self, other: Told) -> Told:
        """Both together; of gravity there is one."""
        mine = self if self.ids else other
        return Told(
            (*self.steps, *other.steps),
            mine.ids,
            mine.gravity,
            mine.gate,
            (*self.records, *other.records),
        )

    def gravity_of(self, ids: Sequence[int]) -> Gravity | None:
        """Gravity as the vertices `ids` of a graph know it."""
        if self.gravity is None:
            return None
        row = {index: k for k, index in enumerate(self.ids)}
        here = [(k, row[index]) for k, index in enumerate(ids) if index in row]
        if not here:
            return None
        vertices, rows = np.array(here, np.intp).T
        return Gravity(vertices, self.gravity[rows, :3], self.gravity[rows, 3], None, self.gate)

    def up(self, graph: PoseGraph) -> Float64 | None:
        """Return the unit vector (3,) against gravity in the graph's world, None without any."""
        known = self.gravity_of(graph.ids.tolist())
        if known is None:
            return None
        down = (graph.poses[known.vertices, :3, :3] @ known.directions[:, :, None])[..., 0]
        # A median: an accelerometer that is shaken measures more than gravity.
        up = -np.median(down, axis=0)
        length = float(np.linalg.norm(up))
        return up / length if length > 0.1 else None

    def between(self, ids: Sequence[int]) -> list[Measured]:
        """Relative poses of some frames in a row (ascending), where all steps between are known."""
        following = {step.i: step for step in self.steps}
        out = []
        for i, j in pairwise(ids):
            T, C, at = np.eye(4), np.zeros((6, 6)), i
            while at in following and at < j:
                step = following[at]
                T, at = T @ step.T_i_j, step.j
                C += np.linalg.inv(step.information)
            if at == j:
                out.append(Measured(i, j, T, np.asarray(np.linalg.inv(C), np.float64)))
        return out


class Outside(Protocol):
    """A sensor beside the camera, and how it is believed."""

    part_kind: ClassVar[str] = "outside"

    def tell(self, sensed: Sensed, graph: PoseGraph) -> Told:
        """Return what it says, given the graph of what was tracked, without loops."""
        ...


@part("outside", "gravity")
@dataclass(frozen=True)
class GravityEdges(Outside):
    """Holds roll and pitch by the direction in which things fall.

    Attributes
    ----------
    shared_rad
        Sigma of that error which all frames share, such as the accelerometer's zero and how it
        is mounted: however many frames, the vertical is not known better.
    gate
        Squared error in units of sigma beyond which a direction hardly counts.
    least
        With fewer frames that know it, gravity is left out.
    """

    shared_rad: float = 0.01
    gate: float = 25.0
    least: int = 3

    def __post_init__(self) -> None:
        if not 1e-6 <= self.shared_rad <= 1:
            raise ValueError(f"shared_rad is {self.shared_rad}, not 1e-6 to 1")
        if not self.gate > 0:
            raise ValueError(f"gate is {self.gate}, not above 0")
        if self.least < 1:
            raise ValueError(f"least is {self.least}, not 1 or more")

    def tell(self, sensed: Sensed, graph: PoseGraph) -> Told:
        """See `Outside.tell`."""
        known = np.flatnonzero(np.isfinite(sensed.gravity).all(1))
        count = len(known)
        if count == 0:
            return Told()
        if count < self.least:
            text = f"only {count} frames know what is down, {self.least} are needed"
            return Told(records=(OutsideRecord("gravity", count, 0, None, text),))
        measured = sensed.gravity[known].copy()
        measured[:, 3] = np.hypot(measured[:, 3], self.shared_rad)
        # By so much each one is worth less, so that all together are not worth more than one
        # could be that had the shared error alone.
        less = 1 + float((self.shared_rad**2 / measured[:, 3] ** 2).sum())
        seen = (graph.poses[known, :3, :3] @ measured[:, :3, None])[..., 0]
        every = Gravity(known, measured[:, :3], measured[:, 3], None, self.gate)
        down = vertical(seen, every)
        away = ((seen - down / np.linalg.norm(down)) ** 2).sum(1) / measured[:, 3] ** 2
        used = int((away <= self.gate).sum())
        measured[:, 3] *= np.sqrt(less)
        ids = tuple(int(index) for index in sensed.ids[known])
        text = f"{used} of {count} directions of gravity agree with the path"
        record = OutsideRecord("gravity", count, used, None, text)
        return Told((), ids, measured, self.gate / less, (record,))


@part("outside", "odometry")
@dataclass(frozen=True)
class OdometryEdges(Outside):
    """Joins frames in a row by the motion between their poses in an odometry file.

    Its errors are compared with those of tracking. If its median motion misses by more than both
    explain, it counts with as many times its errors as it takes; a single step that misses by far
    is left out.

    Attributes
    ----------
    share, share_rad
        Standard deviation of a step, as a share of its length and of its angle.
    least_m, least_rad
        And what is added to it, m and rad.
    limit
        Odometry that asks for more times its errors is not used at all.
    gate
        Squared error of a step, in units of both their errors, beyond which it is left out.
    """

    share: float = 0.05
    share_rad: float = 0.05
    least_m: float = 0.002
    least_rad: float = 0.002
    limit: float = 5.0
    gate: float = 40.0

    def __post_init__(self) -> None:
        for name in ("share", "share_rad"):
            if not 0 <= getattr(self, name) <= 10:
                raise ValueError(f"{name} is {getattr(self, name)}, not 0 to 10")
        for name in ("least_m", "least_rad"):
            if not 1e-6 <= getattr(self, name) <= 10:
                raise ValueError(f"{name} is {getattr(self, name)}, not 1e-6 to 10")
        if not (self.limit >= 1 and self.gate > 0):
            raise ValueError("limit must be 1 or more, and gate above 0")

    def tell(self, sensed: Sensed, graph: PoseGraph) -> Told:
        """See `Outside.tell`."""
        there = np.asarray(np.isfinite(sensed.odometry).all((1, 2)))
        both = there[:-1] & there[1:] & (sensed.parts[:-1] == sensed.parts[1:])
        first = np.flatnonzero(both)
        if not len(first):
            return Told()
        measured = se3.inverse(sensed.odometry[first]) @ sensed.odometry[first + 1]
        C = self._covariance(measured)
        scale = self._scale(sensed, graph, C, first)
        if scale is None:
            text = (
                f"the odometry's motions miss those that were tracked by more than {self.limit:g} "
                "times its errors, so it was not used"
            )
            return Told(records=(OutsideRecord("odometry", len(first), 0, None, text),))
        C = C * scale**2
        tracked = se3.inverse(graph.poses[first]) @ graph.poses[first + 1]
        held = _covariance_to_reference(graph)
        away = _squared(se3.log(se3.inverse(tracked) @ measured), C + held[first] + held[first + 1])
        keep = np.flatnonzero(away <= self.gate)
        steps = tuple(
            Measured(
                int(sensed.ids[first[k]]),
                int(sensed.ids[first[k] + 1]),
                measured[k],
                np.asarray(np.linalg.inv(C[k]), np.float64),
            )
            for k in keep
        )
        text = f"{len(keep)} of {len(first)} steps of the odometry count, "
        text += "with the errors stated" if scale == 1 else f"with {scale:.1f} times its errors"
        record = OutsideRecord("odometry", len(first), len(keep), scale, text)
        return Told(steps, records=(record,))

    def _covariance(self, steps: Float64) -> Float64:
        """(K, 6, 6) of motions (K, 4, 4)."""
        sigma = np.empty((len(steps), 6))
        length, angle = np.linalg.norm(steps[:, :3, 3], axis=1), se3.angle(steps)
        sigma[:, :3] = (self.least_m + self.share * length)[:, None]
        sigma[:, 3:] = (self.least_rad + self.share_rad * angle)[:, None]
        return np.asarray(sigma[:, :, None] ** 2 * np.eye(6))

    def _scale(self, sensed: Sensed, graph: PoseGraph, C: Float64, first: Intp) -> float | None:
        """How many times the stated errors explain the misfit; None beyond the limit.

        Compared are the motions that were measured: from a reference to a frame.
        """
        i, j = graph.edges.T
        # Variances add up along the way; a step without odometry breaks it.
        step = np.full((len(sensed.ids), 6), np.inf)
        step[first + 1] = np.diagonal(C, axis1=1, axis2=2)
        whole = [bool(np.isfinite(step[a + 1 : b + 1]).all()) for a, b in graph.edges]
        known = np.array(whole, bool) & (i < j)
        if not known.any():
            return 1.0
        i, j = i[known], j[known]
        way = np.stack([step[a + 1 : b + 1].sum(0) for a, b in zip(i, j, strict=True)])
        moved = se3.inverse(sensed.odometry[i]) @ sensed.odometry[j]
        e = se3.log(se3.inverse(graph.measurements[known]) @ moved)
        own = np.linalg.inv(graph.information[known])

        def median(scale: float) -> float:
            added = scale**2 * way[:, :, None] * np.eye(6)
            return float(np.median(_squared(e, own + added)))

        if median(1.0) <= _MEDIAN:
            return 1.0
        if median(self.limit) > _MEDIAN:
            return None
        low, high = 1.0, self.limit
        for _ in range(30):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if median(middle) > _MEDIAN else (low, middle)
        return high


def told_by(sensors: Sequence[Outside], sensed: Sensed, graph: PoseGraph) -> Told:
    """Everything that some sensors say of a graph of what was tracked."""
    told = Told()
    for sensor in sensors:
        told = told.joined(sensor.tell(sensed, graph))
    return told


def with_outside(graph: PoseGraph, told: Told) -> PoseGraph:
    """The graph with what sensors say: steps as edges behind the others, and gravity."""
    if not told:
        return graph
    place = {int(index): k for k, index in enumerate(graph.ids)}
    steps = told.steps
    m = len(steps)
    pairs = np.array([(place[s.i], place[s.j]) for s in steps], np.intp).reshape(m, 2)
    return replace(
        graph,
        edges=np.concatenate([graph.edges, pairs]),
        measurements=np.concatenate(
            [graph.measurements, np.array([s.T_i_j for s in steps]).reshape(m, 4, 4)]
        ),
        information=np.concatenate(
            [graph.information, np.array([s.information for s in steps]).reshape(m, 6, 6)]
        ),
        loop=np.concatenate([graph.loop, np.zeros(m, bool)]),
        gravity=told.gravity_of(graph.ids.tolist()),
    )


def _covariance_to_reference(graph: PoseGraph) -> Float64:
    """(N, 6, 6) of each frame relative to the one that it was aligned with; 0 for those without."""
    out = np.zeros((len(graph.ids), 6, 6))
    out[graph.edges[:, 1]] = np.linalg.inv(graph.information)
    return out


def _squared(e: Float64, C: Float64) -> Float64:
    """(K,) squared errors (K, 6) in units of their covariances (K, 6, 6)."""
    return np.asarray((e * np.linalg.solve(C, e[..., None])[..., 0]).sum(1), np.float64)
