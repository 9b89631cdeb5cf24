"""Measurements of the poses by external sensors, as weighted edges of the graph.

They are weighted by their agreement with odometry from images, in units of the errors of both: a
moving accelerometer measures more than gravity, wheels slip, and a file may belong to another
camera or use other axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, ClassVar, Protocol

import numpy as np

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Gravity, Measured, PoseGraph
from tofuse.engine.graph.robust import MEDIAN
from tofuse.engine.parts import part

# With fewer measured frames, a moving accelerometer can't be detected.
_MIN_FRAMES = 3
# Odometry that fewer fully constrained registrations were compared with is not verified.
_MIN_COMPARED = 10


@dataclass(frozen=True, eq=False)
class SensorData:
    """Measurements of external sensors for the frames that have a pose.

    Attributes
    ----------
    ids
        (N,) indices of the frames, ascending.
    odometry
        (N, 4, 4) T_odometry_camera, NaN where there is none.
    gravity
        (N, 4) unit vector of gravity in the camera's frame and its sigma in rad, NaN where there
        is none.
    parts
        (N,) number of the recording, if several are joined: each has its own odometry.
    degenerate
        (N,) frames whose registration leaves some direction unconstrained.
    """

    ids: Intp
    odometry: Float64
    gravity: Float64
    parts: Intp
    degenerate: Bool


@dataclass(frozen=True)
class SensorRecord:
    """Use of a sensor: numbers of its measurements and of those used, and a sentence on it.

    `scale` is the factor on its stated errors, None where they are not scaled; `metric` whether
    tracked lengths agree with those that it measures.
    """

    sensor: str
    measured: int
    used: int
    scale: float | None
    text: str
    metric: bool = False


@dataclass(frozen=True, eq=False)
class SensorPriors:
    """Weighted measurements of the poses by external sensors, by frame index.

    Attributes
    ----------
    steps
        Relative poses of consecutive frames, with their information.
    verified
        Whether the errors of the steps were measured on enough fully constrained registrations.
        Then the steps bound the errors where images don't constrain the motion.
    ids
        Frames with a measured direction of gravity.
    gravity
        (K, 4) as in `SensorData`, with inflated sigmas.
    gate
        See `Gravity.gate`.
    records
        One for each sensor, for the report.
    """

    steps: tuple[Measured, ...] = ()
    ids: tuple[int, ...] = ()
    gravity: Float64 | None = None
    gate: float = np.inf
    records: tuple[SensorRecord, ...] = ()
    verified: bool = False

    def __bool__(self) -> bool:
        return bool(self.steps or self.ids)

    def joined(self, other: SensorPriors) -> SensorPriors:
        """Return the measurements of both; of gravity, those of the first that has any."""
        with_gravity = self if self.ids else other
        return SensorPriors(
            (*self.steps, *other.steps),
            with_gravity.ids,
            with_gravity.gravity,
            with_gravity.gate,
            (*self.records, *other.records),
            self.verified or other.verified,
        )

    def gravity_of(self, ids: Sequence[int]) -> Gravity | None:
        """Gravity at the vertices `ids` of a graph; None if none of them has it."""
        if self.gravity is None:
            return None
        row = {index: k for k, index in enumerate(self.ids)}
        matches = [(k, row[index]) for k, index in enumerate(ids) if index in row]
        if not matches:
            return None
        vertices, rows = np.array(matches, np.intp).T
        return Gravity(vertices, self.gravity[rows, :3], self.gravity[rows, 3], None, self.gate)

    def up(self, graph: PoseGraph) -> Float64 | None:
        """Return the unit vector (3,) opposite to gravity in the graph's world, or None."""
        gravity = self.gravity_of(graph.ids.tolist())
        if gravity is None:
            return None
        down = (graph.poses[gravity.vertices, :3, :3] @ gravity.directions[:, :, None])[..., 0]
        # A median, since a shaken accelerometer measures more than gravity.
        up = -np.median(down, axis=0)
        length = float(np.linalg.norm(up))
        return up / length if length > 0.1 else None

    def between(self, ids: Sequence[int]) -> list[Measured]:
        """Relative poses of successive frames of `ids` (ascending) without gaps between them."""
        step_from = {step.i: step for step in self.steps}
        out = []
        for i, j in pairwise(ids):
            T, C, frame = np.eye(4), np.zeros((6, 6)), i
            while frame in step_from and frame < j:
                step = step_from[frame]
                T, frame = T @ step.T_i_j, step.j
                C += np.linalg.inv(step.information)
            if frame == j:
                out.append(Measured(i, j, T, np.asarray(np.linalg.inv(C), np.float64)))
        return out


class ExternalSensor(Protocol):
    """A sensor next to the camera, and the weighting of its measurements."""

    part_kind: ClassVar[str] = "prior"

    def measure(self, sensed: SensorData, graph: PoseGraph) -> SensorPriors:
        """Return its weighted measurements, given the graph of odometry without loops."""
        ...


@part("prior", "gravity")
@dataclass(frozen=True)
class GravityEdges(Bounded, ExternalSensor):
    """Constrains roll and pitch by the direction of gravity.

    Attributes
    ----------
    shared_rad
        Sigma of the error that all frames share (bias and mounting of the accelerometer), a lower
        bound on that of the vertical, however many frames there are.
    gate
        Squared error in units of sigma beyond which a direction hardly counts.
    """

    shared_rad: Annotated[float, Bounds(1e-6, 1)] = 0.01
    gate: Annotated[float, Bounds(0, exclusive=True)] = 25.0

    def measure(self, sensed: SensorData, graph: PoseGraph) -> SensorPriors:
        """See `ExternalSensor.measure`."""
        rows = np.flatnonzero(np.isfinite(sensed.gravity).all(1))
        count = len(rows)
        if count == 0:
            return SensorPriors()
        if count < _MIN_FRAMES:
            text = f"only {count} frames measure gravity, {_MIN_FRAMES} are needed"
            return SensorPriors(records=(SensorRecord("gravity", count, 0, None, text),))
        measured = sensed.gravity[rows].copy()
        measured[:, 3] = np.hypot(measured[:, 3], self.shared_rad)
        # Factor on each variance, so that all measurements together have no more information than
        # a single one with the shared error alone.
        inflation = 1 + float((self.shared_rad**2 / measured[:, 3] ** 2).sum())
        observed = (graph.poses[rows, :3, :3] @ measured[:, :3, None])[..., 0]
        gravity = Gravity(rows, measured[:, :3], measured[:, 3], None, self.gate)
        down = gravity.vertical(observed)
        chi2 = ((observed - down / np.linalg.norm(down)) ** 2).sum(1) / measured[:, 3] ** 2
        used = int((chi2 <= self.gate).sum())
        measured[:, 3] *= np.sqrt(inflation)
        ids = tuple(int(index) for index in sensed.ids[rows])
        text = f"{used} of {count} directions of gravity agree with the path"
        record = SensorRecord("gravity", count, used, None, text)
        return SensorPriors((), ids, measured, self.gate / inflation, (record,))


@part("prior", "odometry")
@dataclass(frozen=True)
class OdometryEdges(Bounded, ExternalSensor):
    """Connects consecutive frames by the motion between their poses in an odometry file.

    Its errors are compared with those of tracking. If the median misfit is larger than the errors
    of both explain, those of the odometry are scaled until they do; single steps with a far larger
    misfit are rejected.

    Attributes
    ----------
    relative, relative_rad
        Standard deviation of a step, as a fraction of its length and of its angle.
    min_m, min_rad
        Constant part of it, m and rad.
    limit
        Largest factor on its errors; odometry that needs more is not used.
    gate
        Squared error of a step, in units of the errors of both, beyond which it is rejected.
    """

    relative: Annotated[float, Bounds(0, 10)] = 0.05
    relative_rad: Annotated[float, Bounds(0, 10)] = 0.05
    min_m: Annotated[float, Bounds(1e-6, 10)] = 0.002
    min_rad: Annotated[float, Bounds(1e-6, 10)] = 0.002
    limit: Annotated[float, Bounds(1)] = 5.0
    gate: Annotated[float, Bounds(0, exclusive=True)] = 40.0

    def measure(self, sensed: SensorData, graph: PoseGraph) -> SensorPriors:
        """See `ExternalSensor.measure`."""
        valid = np.asarray(np.isfinite(sensed.odometry).all((1, 2)))
        consecutive = valid[:-1] & valid[1:] & (sensed.parts[:-1] == sensed.parts[1:])
        first = np.flatnonzero(consecutive)
        if not len(first):
            return SensorPriors()
        measured = se3.inverse(sensed.odometry[first]) @ sensed.odometry[first + 1]
        C = self._covariance(measured)
        compared = self._compare(sensed, graph, C, first)
        scale = 1.0 if compared is None else compared.scale(self.limit)
        if scale is None:
            text = (
                f"the odometry differs from the tracked motion by more than {self.limit:g} times "
                "its errors, so it was not used"
            )
            return SensorPriors(records=(SensorRecord("odometry", len(first), 0, None, text),))
        C = C * scale**2
        tracked = se3.inverse(graph.poses[first]) @ graph.poses[first + 1]
        tracking_covariance = _covariance_to_reference(graph)
        chi2 = _squared(
            se3.log(se3.inverse(tracked) @ measured),
            C + tracking_covariance[first] + tracking_covariance[first + 1],
        )
        kept = np.flatnonzero(chi2 <= self.gate)
        steps = tuple(
            Measured(
                int(sensed.ids[first[k]]),
                int(sensed.ids[first[k] + 1]),
                measured[k],
                np.asarray(np.linalg.inv(C[k]), np.float64),
            )
            for k in kept
        )
        text = f"{len(kept)} of {len(first)} steps of the odometry are used, "
        text += "with the stated errors" if scale == 1 else f"with {scale:.1f} times its errors"
        metric = compared is not None and compared.lengths_agree(scale)
        record = SensorRecord("odometry", len(first), len(kept), scale, text, metric)
        verified = compared is not None and compared.verified
        return SensorPriors(steps, records=(record,), verified=verified)

    def _covariance(self, steps: Float64) -> Float64:
        """(K, 6, 6) of motions (K, 4, 4)."""
        sigma = np.empty((len(steps), 6))
        length, angle = np.linalg.norm(steps[:, :3, 3], axis=1), se3.angle(steps)
        sigma[:, :3] = (self.min_m + self.relative * length)[:, None]
        sigma[:, 3:] = (self.min_rad + self.relative_rad * angle)[:, None]
        return np.asarray(sigma[:, :, None] ** 2 * np.eye(6))

    def _compare(
        self, sensed: SensorData, graph: PoseGraph, C: Float64, first: Intp
    ) -> _Comparison | None:
        """Compare the motions from references to frames with the tracker's registrations.

        Only fully constrained registrations are compared, if there are enough. None without any.
        """
        i, j = graph.edges.T
        # Variances add up along the path; a step without odometry breaks it.
        step = np.full((len(sensed.ids), 6), np.inf)
        step[first + 1] = np.diagonal(C, axis1=1, axis2=2)
        unbroken = [bool(np.isfinite(step[a + 1 : b + 1]).all()) for a, b in graph.edges]
        compared = np.array(unbroken, bool) & (i < j)
        constrained = compared & ~(sensed.degenerate[i] | sensed.degenerate[j])
        verified = bool(constrained.sum() >= _MIN_COMPARED)
        if verified:
            compared = constrained
        if not compared.any():
            return None
        i, j = i[compared], j[compared]
        return _Comparison(
            graph.measurements[compared],
            np.asarray(np.linalg.inv(graph.information[compared]), np.float64),
            np.asarray(se3.inverse(sensed.odometry[i]) @ sensed.odometry[j], np.float64),
            np.stack([step[a + 1 : b + 1].sum(0) for a, b in zip(i, j, strict=True)]),
            verified,
        )


@dataclass(frozen=True, eq=False)
class _Comparison:
    """The same K motions by the tracker and by odometry.

    Attributes
    ----------
    tracked, covariances
        (K, 4, 4), and (K, 6, 6) as right perturbations.
    odometry, variances
        (K, 4, 4), and (K, 6) by the stated errors.
    verified
        See `SensorPriors`.
    """

    tracked: Float64
    covariances: Float64
    odometry: Float64
    variances: Float64
    verified: bool

    def scale(self, limit: float) -> float | None:
        """Factor on the stated errors that explains the misfit, from 1 to `limit`, or None."""
        misfit = se3.log(se3.inverse(self.tracked) @ self.odometry)

        def median(scale: float) -> float:
            added = scale**2 * self.variances[:, :, None] * np.eye(6)
            return float(np.median(_squared(misfit, self.covariances + added)))

        if median(1.0) <= MEDIAN:
            return 1.0
        if median(limit) > MEDIAN:
            return None
        low, high = 1.0, limit
        for _ in range(30):
            mid = 0.5 * (low + high)
            low, high = (mid, high) if median(mid) > MEDIAN else (low, mid)
        return high

    def lengths_agree(self, scale: float) -> bool:
        """Whether tracked lengths differ from those of the odometry by less than half (95 %).

        Parameters
        ----------
        scale
            Factor on the stated errors.
        """
        t, o = self.tracked[:, :3, 3], self.odometry[:, :3, 3]
        variance = np.trace(self.covariances[:, :3, :3], axis1=1, axis2=2)
        weight = 3 / (variance + scale**2 * self.variances[:, :3].sum(1))
        information = float((weight * (o * o).sum(1)).sum())
        if information == 0:
            return False
        ratio = float((weight * (t * o).sum(1)).sum()) / information
        return bool(abs(ratio - 1) + 2 / np.sqrt(information) < 0.5)


def measure_all(
    sensors: Sequence[ExternalSensor], sensed: SensorData, graph: PoseGraph
) -> SensorPriors:
    """Return the measurements of all sensors, given the graph of odometry without loops."""
    measured = SensorPriors()
    for sensor in sensors:
        measured = measured.joined(sensor.measure(sensed, graph))
    return measured


def with_sensors(graph: PoseGraph, measured: SensorPriors) -> PoseGraph:
    """Return the graph with the measurements: steps as further edges, and gravity."""
    if not measured:
        return graph
    position = {int(index): k for k, index in enumerate(graph.ids)}
    steps = measured.steps
    m = len(steps)
    pairs = np.array([(position[s.i], position[s.j]) for s in steps], np.intp).reshape(m, 2)
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
        gravity=measured.gravity_of(graph.ids.tolist()),
    )


def _covariance_to_reference(graph: PoseGraph) -> Float64:
    """(N, 6, 6) of each frame relative to its reference; 0 for those without one."""
    out = np.zeros((len(graph.ids), 6, 6))
    out[graph.edges[:, 1]] = np.linalg.inv(graph.information)
    return out


def _squared(e: Float64, C: Float64) -> Float64:
    """(K,) squared errors (K, 6) in units of their covariances (K, 6, 6)."""
    return np.asarray((e * np.linalg.solve(C, e[..., None])[..., 0]).sum(1), np.float64)
