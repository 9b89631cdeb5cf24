"""Measurements of the poses by external sensors, as weighted edges of the graph.

They are weighted by their agreement with odometry from images, in units of the errors of both: a
moving accelerometer measures more than gravity, wheels slip, and a file may belong to another
camera or use other axes. Tracking's covariances are accurate along short paths, and measure the
errors of odometry; odometry then measures those of refined pairs, which share errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, ClassVar, Protocol

import numpy as np
from scipy.special import chdtri

from tofuse.engine import quantities
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.frames import evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Gravity, Measured, PoseGraph
from tofuse.engine.graph.graph_covariances import GraphCovariances
from tofuse.engine.graph.robust import MEDIAN
from tofuse.engine.parts import part

# With fewer measured frames, a moving accelerometer can't be detected.
_MIN_FRAMES = 3
# Largest factor on the errors of refined registrations.
_MAX_DEPTH_SCALE = 30.0
# Number of frames whose motions are compared with those of odometry.
_COMPARED = 60
# Degrees of freedom of the t distribution of disagreements: jumps and false registrations are rare.
_DEGREES = 30.0
# Standard deviation of the logarithm of the factors.
_SPREAD = np.log(2.0)
# Least factor on the errors of odometry: over short motions a phone's are smaller than stated.
_BETTER = 0.5
# Odometry that fewer fully constrained registrations were compared with is not verified.
_MIN_COMPARED = 10
# Devices jump rarely: if more of the steps are rejected, their errors are other ones than assumed.
_MAX_REJECTED = 0.1
# Standard deviation of the factor on all lengths of odometry, as of wheels whose radius is not well
# known, and how much likelier it must be that they differ from tracked ones at all.
_LENGTHS, _LIKELIER = 0.02, 10.0
_MOUNTING_ROUNDS = 5
_MAX_LENGTHS = 5.0  # largest error of lengths, in units of this
# Factor on the errors of odometry within which loops may contradict it where images don't constrain
# the motion: wheels may slip there.
_DOUBT = 5.0
# Squared disagreement, in units of tracking's errors, that one in a hundred motions of independent
# odometry does not reach: if half of all don't, these errors are odometry's as well.
_SHARED = float(chdtri(6, 0.99))


@dataclass(frozen=True, eq=False)
class SensorData:
    """Measurements of external sensors for the frames that have a pose.

    Attributes
    ----------
    ids
        (N,) indices of the frames, ascending.
    times
        (N,) s.
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
    times: Float64
    odometry: Float64
    gravity: Float64
    parts: Intp
    degenerate: Bool


@dataclass(frozen=True)
class SensorRecord:
    """Use of a sensor: numbers of its measurements and of those used, and a sentence on it.

    `scale` is the factor on its stated errors, None where they are not scaled; `lengths` that on
    its lengths, see `OdometryEdges`; `metric` whether tracked lengths agree with those.
    """

    sensor: str
    measured: int
    used: int
    scale: float | None
    text: str
    lengths: float = 1.0
    metric: bool = False


@dataclass(frozen=True, eq=False)
class SensorPriors:
    """Weighted measurements of the poses by external sensors, by frame index.

    Attributes
    ----------
    steps
        Relative poses of consecutive frames, with their information.
    verified
        Whether the errors of the steps were measured on enough fully constrained registrations,
        most of which agree. Then they bound the errors where images don't constrain the motion.
    depth_scale
        Factors on the sigmas of registrations, of translation and of rotation.
    ids
        Frames with a measured direction of gravity.
    gravity
        (K, 4) as in `SensorData`, with inflated sigmas.
    gate
        See `Gravity.gate`.
    records
        One for each sensor, for the report.
    witness
        Steps of odometry that poses are compared with, but which don't change them.
    lengths
        Factor by which the lengths of odometry were multiplied, see `OdometryEdges`.
    """

    steps: tuple[Measured, ...] = ()
    ids: tuple[int, ...] = ()
    gravity: Float64 | None = None
    gate: float = np.inf
    records: tuple[SensorRecord, ...] = ()
    verified: bool = False
    depth_scale: tuple[float, float] = (1.0, 1.0)
    witness: tuple[Measured, ...] = ()
    lengths: float = 1.0

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
            self.depth_scale if self.steps else other.depth_scale,
            lengths=self.lengths if self.steps else other.lengths,
        )

    @property
    def is_reliable(self) -> bool:
        """Whether few steps of odometry were rejected, as where a device relocalizes."""
        odometry = [r for r in self.records if r.sensor == "odometry"]
        return all(r.measured - r.used <= _MAX_REJECTED * r.measured for r in odometry)

    def with_depth_scale_at_least(self, least: tuple[float, float]) -> SensorPriors:
        """Return the measurements with a `depth_scale` of at least this."""
        translation, rotation = np.maximum(self.depth_scale, least).tolist()
        return replace(self, depth_scale=(translation, rotation))

    def doubted(self, steps: Sequence[Measured]) -> list[Measured]:
        """Return steps with the errors that the search for loops allows for; none if unverified."""
        if not self.verified:
            return []
        return [replace(step, information=step.information / _DOUBT**2) for step in steps]

    def gravity_of(self, ids: Sequence[int]) -> Gravity | None:
        """Gravity at the vertices `ids` of a graph; None if none of them has it."""
        if self.gravity is None:
            return None
        row = {index: k for k, index in enumerate(self.ids)}
        matches = [(k, row[index]) for k, index in enumerate(ids) if index in row]
        if not matches:
            return None
        vertices, rows = np.array(matches, np.intp).T
        return Gravity(vertices, self.gravity[rows, :3], self.gravity[rows, 3], self.gate)

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

    def witnessed(self, ids: Sequence[int]) -> list[tuple[Intp, Float64]]:
        """Return the runs of ascending frames that the witness connects.

        Their positions (K,) in `ids`, and their poses (K, 4, 4) in the first one's frame.
        """
        position = {index: k for k, index in enumerate(ids)}
        runs: list[tuple[list[int], list[Float64]]] = []
        for step in _between(self.witness, ids):
            i, j = position[step.i], position[step.j]
            if not runs or runs[-1][0][-1] != i:
                runs.append(([i], [np.eye(4)]))
            positions, poses = runs[-1]
            positions.append(j)
            poses.append(poses[-1] @ step.T_i_j)
        return [(np.array(positions, np.intp), np.array(poses)) for positions, poses in runs]

    def between(self, ids: Sequence[int]) -> list[Measured]:
        """Relative poses of successive frames of `ids` (ascending) without gaps between them."""
        return _between(self.steps, ids)


def _between(steps: Sequence[Measured], ids: Sequence[int]) -> list[Measured]:
    step_from = {step.i: step for step in steps}
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
            text = f"gravity in only {quantities.count(count, 'frame')}, {_MIN_FRAMES} are needed"
            return SensorPriors(records=(SensorRecord("gravity", count, 0, None, text),))
        measured = sensed.gravity[rows].copy()
        measured[:, 3] = np.hypot(measured[:, 3], self.shared_rad)
        # Factor on each variance, so that all measurements together have no more information than
        # a single one with the shared error alone.
        inflation = 1 + float((self.shared_rad**2 / measured[:, 3] ** 2).sum())
        observed = (graph.poses[rows, :3, :3] @ measured[:, :3, None])[..., 0]
        down = Gravity(rows, measured[:, :3], measured[:, 3], self.gate).vertical(observed)
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

    Its errors are random walks over time, length and angle, and a factor on all lengths, as by a
    wrong radius of wheels. The walks are scaled until these and the errors of tracking explain the
    disagreement of the two; steps with a far larger one, alone or together, are rejected. Where
    images don't constrain the motion, as many jumps are expected among the others. The lengths are
    corrected if it is far likelier that they differ, by a Bayesian comparison. Odometry that agrees
    with tracking better than the errors of tracking allow shares them, as if it were computed from
    the same depth. Then it is no evidence, except where the depth has none.

    Attributes
    ----------
    drift_m, drift_rad
        Standard deviation after one second.
    relative, relative_rad
        Additional standard deviation after one metre, as a fraction; and after one radian.
    limit
        Largest factor on its errors; odometry that needs more is not used.
    gate
        Squared error of a step, in units of the errors of both, beyond which it is rejected.
    scale
        Factor on its errors; None: estimated by comparison with the tracked motion. It is given
        where the path rests on this odometry already, so that their agreement shows nothing.
    """

    drift_m: Annotated[float, Bounds(1e-6, 10)] = 0.005
    drift_rad: Annotated[float, Bounds(1e-6, 10)] = 0.001
    relative: Annotated[float, Bounds(0, 10)] = 0.01
    relative_rad: Annotated[float, Bounds(0, 10)] = 0.003
    limit: Annotated[float, Bounds(1)] = 5.0
    gate: Annotated[float, Bounds(0, exclusive=True)] = 40.0
    scale: Annotated[float | None, Bounds(0, exclusive=True)] = None

    def measure(self, sensed: SensorData, graph: PoseGraph) -> SensorPriors:
        """See `ExternalSensor.measure`."""
        valid = np.asarray(np.isfinite(sensed.odometry).all((1, 2)))
        consecutive = valid[:-1] & valid[1:] & (sensed.parts[:-1] == sensed.parts[1:])
        first = np.flatnonzero(consecutive)
        if not len(first):
            return SensorPriors()
        stated = se3.inverse(sensed.odometry[first]) @ sensed.odometry[first + 1]
        variances = self._variances(stated, sensed.times[first + 1] - sensed.times[first])
        tracked = se3.inverse(graph.poses[first]) @ graph.poses[first + 1]
        tracking_covariance = _covariance_to_reference(graph)
        used, slipped = np.ones(len(first), bool), np.zeros(len(first), bool)
        # Then without the rejected steps: a jump is in all longer motions over it.
        for _ in range(2):
            compared, lengths = None, _Lengths()
            if self.scale is None:
                compared = _compare(sensed, graph, variances[used], first[used])
            if compared is not None and compared.verified:
                lengths = compared.lengths((_BETTER, self.limit))
                compared = replace(compared, odometry=lengths.corrected(compared.odometry))
            measured = lengths.corrected(stated)
            misfit = se3.log(se3.inverse(tracked) @ measured)
            found = (
                np.full((2, 2), self.scale or 1.0)
                if compared is None
                else compared.scales((1.0, 1.0), (_BETTER, self.limit))
            )
            if found is None:
                text = (
                    f"the odometry differs from the tracked motion by more than {self.limit:g} "
                    "times its errors, so it was not used"
                )
                body = None if compared is None else compared.mounting((_BETTER, self.limit))
                if body is not None:
                    text += (
                        f"; it agrees for a camera turned by {np.degrees(se3.angle(body)):.0f} "
                        "degrees: are the poses those of a robot's base? They must be the camera's"
                    )
                return SensorPriors(records=(SensorRecord("odometry", len(first), 0, None, text),))
            scales, odometry_scale = found, found[1]
            enlarged = (variances * np.repeat(np.maximum(odometry_scale, 1) ** 2, 3))[:, :, None]
            chi2 = _squared(
                misfit,
                enlarged * np.eye(6) + tracking_covariance[first] + tracking_covariance[first + 1],
            )
            if compared is not None and compared.verified:
                slipped |= compared.beyond(scales, self.gate, len(sensed.ids))[first]
            used = (chi2 <= self.gate) & ~slipped
            if used.all() or not used.any():
                break
        C = (variances * np.repeat(odometry_scale**2, 3))[:, :, None] * np.eye(6)
        open_step = sensed.degenerate[first] | sensed.degenerate[first + 1]
        C += lengths.covariances(measured, open_step)
        jumps = misfit[~used & ~open_step]
        C[open_step] += jumps.T @ jumps / max(int((~open_step).sum()), 1)
        # Odometry that is mostly wrong where images can tell bounds nothing where they can't.
        is_wrong = not open_step.all() and bool(used[~open_step].mean() < 0.5)
        shared = compared is not None and compared.shares_errors
        if shared:  # it says something only where the depth says nothing
            used &= open_step
        kept = np.flatnonzero(used)
        steps = tuple(
            Measured(
                int(sensed.ids[first[k]]),
                int(sensed.ids[first[k] + 1]),
                measured[k],
                np.asarray(np.linalg.inv(C[k]), np.float64),
            )
            for k in kept
        )
        scale = float(odometry_scale.max())
        text = f"{len(kept)} of {len(first)} steps of the odometry are used, "
        text += (
            "with the stated errors"
            if abs(scale - 1) < 0.05
            else f"with {scale:.1f} times its errors"
        )
        if shared:
            text += (
                ", those where images don't constrain the motion: it agrees with the tracked "
                "motion better than the errors of the depth allow, as if it were computed from it"
            )
        if lengths.factor != 1:
            text += f"; its lengths are multiplied by {lengths.factor:.3f}, as tracked ones differ"
        metric = compared is not None and compared.lengths_agree(scales)
        record = SensorRecord(
            "odometry", len(first), len(kept), scale, text, lengths.factor, metric
        )
        verified = self.scale is not None or (compared is not None and compared.verified)
        return SensorPriors(
            steps, records=(record,), verified=verified and not is_wrong, lengths=lengths.factor
        )

    def _variances(self, steps: Float64, seconds: Float64) -> Float64:
        """(K, 6) of motions (K, 4, 4)."""
        length, angle = np.linalg.norm(steps[:, :3, 3], axis=1), se3.angle(steps)
        seconds = np.maximum(seconds, 1e-6)
        variance = [
            self.drift_m**2 * seconds + self.relative**2 * length,
            self.drift_rad**2 * seconds + self.relative_rad**2 * angle,
        ]
        return np.repeat(np.stack(variance, 1), 3, axis=1)


@dataclass(frozen=True)
class _Lengths:
    """A factor that lengths of odometry are multiplied by, and its standard deviation."""

    factor: float = 1.0
    sigma: float = 0.0

    def corrected(self, motions: Float64) -> Float64:
        """Return motions (K, 4, 4) with the corrected lengths."""
        out = motions.copy()
        out[:, :3, 3] *= self.factor
        return out

    def covariances(self, steps: Float64, open_steps: Bool) -> Float64:
        """Return the covariances (K, 6, 6) that make `sigma` count along runs of open steps.

        All steps share the error. As if they were independent, each of a run gets as much as makes
        the error at its end right. Elsewhere images measure the lengths.
        """
        runs = np.cumsum(np.diff(open_steps, prepend=False))  # also of steps that aren't open
        along = _along(steps)
        length = np.linalg.norm(along, axis=1)
        of_run = np.bincount(runs, length)[runs]
        per_length = np.divide(of_run, length, out=np.zeros(len(length)), where=length > 0)
        weight = np.where(open_steps, self.sigma**2 * per_length, 0.0)
        return np.asarray(weight[:, None, None] * along[:, :, None] * along[:, None, :])


@dataclass(frozen=True, eq=False)
class _Fit:
    """Factors on the errors (2, 2), see `_Comparison.scales`; relative error of the lengths; cost.

    The cost is the negative logarithm of the likelihood and the prior.
    """

    scales: Float64
    length_error: float
    cost: float


@dataclass(frozen=True, eq=False)
class _Comparison:
    """The same K motions by the tracker and by odometry.

    Attributes
    ----------
    tracked, covariances
        (K, 4, 4), and (K, 6, 6) as right perturbations.
    odometry, variances
        (K, 4, 4), and (K, 6) by the stated errors.
    ends
        (K, 2) positions of their first and last frames.
    spans
        (K,) number of compared frames from the first to the last.
    verified
        See `SensorPriors`.
    """

    tracked: Float64
    covariances: Float64
    odometry: Float64
    variances: Float64
    ends: Intp
    spans: Intp
    verified: bool

    def scales(
        self, registrations: tuple[float, float], odometry: tuple[float, float]
    ) -> Float64 | None:
        """Most likely factors on the sigmas of registrations and of odometry (2, 2).

        Each of translation and of rotation, within the given limits; None if they don't explain
        the disagreement.
        """
        fit = self._fit(registrations, odometry)
        median = float(np.median(_squared(self._misfit, self._covariances(fit.scales))))
        return fit.scales if median <= 2 * MEDIAN else None

    def beyond(self, scales: Float64, gate: float, frames: int) -> Bool:
        """Return from which of all frames odometry is in a motion that disagrees beyond the gate.

        Of the shortest motions only. A wheel that slips for a while shows in them, where each step
        is within its errors.
        """
        squares = _squared(self._misfit, self._covariances(scales))
        out = np.zeros(frames, np.bool_)
        for a, b in self.ends[(self.spans == 1) & (squares > gate)]:
            out[a:b] = True
        return out

    def mounting(self, odometry: tuple[float, float]) -> Float64 | None:
        """Return the pose T_body_camera (4, 4) with which both agree; None if none does.

        As a hand-eye calibration by the shortest motions: its turn takes axes and translations of
        the tracked ones to those of odometry, less what the arm moves as the body turns.
        """
        part = next(self.by_length(), None)
        if part is None:
            return None
        T_body_camera, R, t = np.eye(4), part.odometry[:, :3, :3], part.odometry[:, :3, 3]
        tracked = np.concatenate([se3.log(part.tracked)[:, 3:], part.tracked[:, :3, 3]])
        for _ in range(_MOUNTING_ROUNDS):
            moved = t - ((np.eye(3) - R) @ T_body_camera[:3, 3])
            of_body = np.concatenate([se3.log(part.odometry)[:, 3:], moved])
            T_body_camera[:3, :3] = se3.nearest_rotation(of_body.T @ tracked)
            left = t - part.tracked[:, :3, 3] @ T_body_camera[:3, :3].T
            arm = np.linalg.lstsq((np.eye(3) - R).reshape(-1, 3), left.ravel(), rcond=1e-3)[0]
            T_body_camera[:3, 3] = arm
        as_camera = np.asarray(se3.inverse(T_body_camera) @ part.odometry @ T_body_camera)
        agrees = replace(part, odometry=as_camera).scales((1.0, 1.0), odometry) is not None
        return T_body_camera if agrees else None

    def lengths(self, odometry: tuple[float, float]) -> _Lengths:
        """Return the factor on the lengths of odometry; it is 1 unless another is far likelier.

        From motions over the number of frames over which they tell most: longer ones are sums of
        shorter ones, so that together they would seem to tell more than they do.
        """
        if not (parts := list(self.by_length())):
            return _Lengths(sigma=_LENGTHS)
        part = max(parts, key=lambda part: part._length_information(np.ones((2, 2))))
        same, differ = (part._fit((1.0, 1.0), odometry, sigma) for sigma in (0.0, _LENGTHS))
        information = part._length_information(differ.scales) + _LENGTHS**-2
        # By Laplace's approximation.
        likelier = same.cost - differ.cost - 0.5 * np.log(information * _LENGTHS**2)
        factor = 1 - differ.length_error if likelier > np.log(_LIKELIER) else 1.0
        return _Lengths(factor, float(1 / np.sqrt(information)))

    def _fit(
        self,
        registrations: tuple[float, float],
        odometry: tuple[float, float],
        lengths: float = 0.0,
    ) -> _Fit:
        """Fit the factors within their limits, and an error of lengths with this sigma."""
        from scipy.optimize import minimize  # slow to import

        misfit, along = self._misfit, _along(self.odometry)
        weight = 1 / self.spans  # about as many are independent as don't overlap

        def cost(x: Float64) -> float:
            C = self._covariances(np.exp(x[:4]).reshape(2, 2))
            left = misfit - lengths * x[4] * along
            likelihood = 0.5 * np.linalg.slogdet(C)[1] + 0.5 * (_DEGREES + 6) * np.log1p(
                _squared(left, C) / _DEGREES
            )
            prior = 0.5 * float((x[2:4] ** 2).sum() / _SPREAD**2 + x[4] ** 2)
            return float((weight * likelihood).sum()) + prior

        low, high = np.log(np.repeat([registrations, odometry], 2, axis=0)).T
        free = _MAX_LENGTHS if lengths else 0.0
        bounds = [*zip(low, high, strict=True), (-free, free)]
        fit = minimize(cost, np.append(0.3 * high, 0.0), method="L-BFGS-B", bounds=bounds)
        return _Fit(np.exp(fit.x[:4]).reshape(2, 2), lengths * float(fit.x[4]), float(fit.fun))

    def _length_information(self, scales: Float64) -> float:
        """Information of the motions on an error of the lengths of odometry."""
        along = _along(self.odometry)
        return float((_squared(along, self._covariances(scales)) / self.spans).sum())

    def by_length(self) -> Iterator[_Comparison]:
        """Yield those over each number of frames, if there are several."""
        for span in np.unique(self.spans):
            of = self.spans == span
            if of.sum() >= _MIN_FRAMES:
                yield _Comparison(
                    self.tracked[of],
                    self.covariances[of],
                    self.odometry[of],
                    self.variances[of],
                    self.ends[of],
                    self.spans[of],
                    self.verified,
                )

    def _covariances(self, scales: Float64) -> Float64:
        """(K, 6, 6) of the disagreement, by `scales`."""
        added = self.variances * np.repeat(scales[1] ** 2, 3)
        return np.asarray(_scaled(self.covariances, scales[0]) + added[:, :, None] * np.eye(6))

    @property
    def shares_errors(self) -> bool:
        """Whether odometry has the errors of tracking, over short motions and over long ones."""
        return self.verified and all(
            float(np.median(_squared(part._misfit, part.covariances))) < _SHARED
            for part in self.by_length()
        )

    @property
    def _misfit(self) -> Float64:
        """(K, 6) disagreement of the two."""
        return se3.log(se3.inverse(self.tracked) @ self.odometry)

    def lengths_agree(self, scales: Float64) -> bool:
        """Whether tracked lengths differ from those of the odometry by less than half (95 %).

        Motions over more frames are sums of those over fewer, so that the number of frames is taken
        over which they tell most; about as many of them are independent as don't overlap.
        """
        t, o = self.tracked[:, :3, 3], self.odometry[:, :3, 3]
        sigmas2 = np.trace(self._covariances(scales)[:, :3, :3], axis1=1, axis2=2) / 3
        weight = 1 / (sigmas2 * self.spans)
        information = np.bincount(self.spans, weight * (o * o).sum(1))
        span = int(information.argmax())
        if information[span] == 0:
            return False
        ratio = np.bincount(self.spans, weight * (t * o).sum(1))[span] / information[span]
        return bool(abs(ratio - 1) + 2 / np.sqrt(information[span]) < 0.5)


def _compare(
    sensed: SensorData, graph: PoseGraph, variances: Float64, first: Intp
) -> _Comparison | None:
    """Compare motions over 1, 2, 4 ... of evenly spaced frames, each with its covariance.

    Motions over degenerate frames are left out if enough remain. None without any.
    """
    frames = evenly_spaced(np.arange(len(sensed.ids)), _COMPARED)
    # Variances add up along the path; a step without odometry breaks it.
    variance = np.zeros((len(sensed.ids), 6))
    variance[first + 1] = variances
    measured = np.zeros(len(sensed.ids), np.intp)
    measured[first + 1] = 1
    variance, measured = variance.cumsum(0), measured.cumsum()
    degenerate = sensed.degenerate.cumsum()
    spans = [2**k for k in range(len(frames).bit_length())]
    i = np.concatenate([np.arange(max(len(frames) - span, 0)) for span in spans])
    j = np.concatenate([np.arange(span, len(frames)) for span in spans])
    a, b = frames[i], frames[j]
    compared = measured[b] - measured[a] == b - a
    constrained = compared & (degenerate[b] == degenerate[a]) & ~sensed.degenerate[a]
    verified = bool((constrained & (j - i == 1)).sum() >= _MIN_COMPARED)
    compared = constrained if verified else compared
    joint = GraphCovariances(graph).joint(frames) if compared.any() else None
    if joint is None:
        return None
    i, j, a, b = i[compared], j[compared], a[compared], b[compared]
    tracked = se3.inverse(graph.poses[a]) @ graph.poses[b]
    C = joint.reshape(len(frames), 6, len(frames), 6).swapaxes(1, 2)
    A = -se3.adjoint(se3.inverse(tracked))
    At = np.swapaxes(A, 1, 2)
    covariances = A @ C[i, i] @ At + A @ C[i, j] + C[j, i] @ At + C[j, j]
    return _Comparison(
        tracked,
        covariances,
        np.asarray(se3.inverse(sensed.odometry[a]) @ sensed.odometry[b], np.float64),
        variance[b] - variance[a],
        np.stack([a, b], 1),
        j - i,
        verified,
    )


def measure_all(
    sensors: Sequence[ExternalSensor], sensed: SensorData, graph: PoseGraph
) -> SensorPriors:
    """Return the measurements of all sensors, given the graph of odometry without loops."""
    measured = SensorPriors()
    for sensor in sensors:
        measured = measured.joined(sensor.measure(sensed, graph))
    return measured


def with_depth_scale(measured: SensorPriors, sensed: SensorData, graph: PoseGraph) -> SensorPriors:
    """Return measurements with the errors of another graph's registrations, given odometry's.

    The pairs of a refined graph agree with each other, as errors of the depth that bend all of them
    alike are invisible to them: by their number they seem far more accurate than they are. Those of
    odometry were estimated from single registrations, which claim less.
    """
    odometry = _Lengths(measured.lengths).corrected(sensed.odometry)
    sensed = replace(sensed, odometry=odometry)
    row = {int(index): k for k, index in enumerate(sensed.ids)}
    first = np.array([row[step.i] for step in measured.steps], np.intp)
    information = np.array([step.information for step in measured.steps])
    variances = 1 / np.diagonal(information, axis1=1, axis2=2)
    compared = _compare(sensed, graph, variances, first)
    if compared is None:
        return measured
    found = [part.scales((1.0, _MAX_DEPTH_SCALE), (1.0, 1.0)) for part in compared.by_length()]
    translation, rotation = np.max([np.ones(2), *(s[0] for s in found if s is not None)], 0)
    return replace(measured, depth_scale=(float(translation), float(rotation)))


def with_sensors(graph: PoseGraph, measured: SensorPriors) -> PoseGraph:
    """Return the graph with the measurements: steps as further edges, and gravity.

    The covariances of its own edges are scaled by `SensorPriors.depth_scale`.
    """
    if not measured:
        return graph
    own = graph.information
    if measured.depth_scale != (1.0, 1.0):
        own = _scaled(own, 1 / np.array(measured.depth_scale))
    gravity = measured.gravity_of(graph.ids.tolist())
    return replace(graph, information=own, gravity=gravity).with_edges(measured.steps)


def _covariance_to_reference(graph: PoseGraph) -> Float64:
    """(N, 6, 6) of each frame relative to its reference; 0 for those without one."""
    out = np.zeros((len(graph.ids), 6, 6))
    out[graph.edges[:, 1]] = np.linalg.inv(graph.information)
    return out


def _along(motions: Float64) -> Float64:
    """Right perturbations (K, 6) of motions (K, 4, 4) by a relative error of their lengths."""
    along = np.zeros((len(motions), 6))
    along[:, :3] = np.einsum("kji,kj->ki", motions[:, :3, :3], motions[:, :3, 3])
    return along


def _scaled(C: Float64, factors: Float64) -> Float64:
    """Covariances (K, 6, 6) with factors (2,) on the sigmas of translation and of rotation."""
    sigma = np.repeat(factors, 3)
    return np.asarray(C * np.outer(sigma, sigma))


def _squared(e: Float64, C: Float64) -> Float64:
    """(K,) squared errors (K, 6) in units of their covariances (K, 6, 6)."""
    return np.asarray((e * np.linalg.solve(C, e[..., None])[..., 0]).sum(1), np.float64)
