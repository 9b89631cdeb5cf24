"""Hand-eye calibration of two trajectories of one rig with free-running clocks.

Camera a moves by A while camera b, fixed to it, moves by B: A X = X B, with X = T_a_b (Tsai and
Lenz, 1989). Relative motions give an initial X; then all poses are fitted jointly by X, by the
transformation Y between the two worlds, and by the offset of b's timestamps: T_a X = Y T_b. Errors
of trajectories are correlated in time: the covariance models them as a first-order process with the
correlation time of the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from tofuse.apps.rigs.clocks import Lag, lag_between
from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.errors import RegistrationError
from tofuse.engine.geometry import se3
from tofuse.engine.normal import MEDIAN_OF_NORMAL

# Unit of the time offset, as `UNITS` of poses: 1 ms.
_TIME_UNIT = 1e-3
# Largest gap across which poses are interpolated, in intervals; minimum number of common poses.
_MAX_GAP, _MIN_COMMON = 3.5, 12
# Durations of motions A and B, as fractions of the common time.
_SPANS = (0.02, 0.05, 0.1, 0.2, 0.35)
_ITERATIONS, _CONVERGENCE = 30, 1e-4
# Threshold of Tukey's biweight in sigmas; minimum sigma of a pose, in units.
_TUKEY, _MIN_SIGMA = 4.7, 0.02
# Upper 95 % bound, in standard errors.
_BOUND_SIGMAS = 1.64
# Sigma of an unconstrained direction, in units.
_UNCONSTRAINED_SIGMA = 100.0


@dataclass(frozen=True, eq=False)
class Track:
    """A camera's own trajectory: times (N,), s, ascending, and T_world_camera (N, 4, 4)."""

    times: Float64
    poses: Float64

    @classmethod
    def of(cls, times: Float64, poses: Float64) -> Track:
        """Return the track of the frames with a pose, whose times may be in any order."""
        posed = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
        posed = posed[np.argsort(times[posed], kind="stable")]
        return cls(times[posed], poses[posed])

    @property
    def interval(self) -> float:
        """Typical time between poses, s."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else 0.0

    def at(self, times: Float64) -> tuple[Float64, Bool]:
        """Return the interpolated poses at other times, and whether they are valid."""
        right = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        before, after = self.times[right - 1], self.times[right]
        gap = after - before
        fraction = (times - before) / np.maximum(gap, 1e-12)
        valid = (fraction >= 0) & (fraction <= 1) & (gap <= _MAX_GAP * self.interval)
        T = se3.interpolate(self.poses[right - 1], self.poses[right], np.clip(fraction, 0, 1))
        return T, valid

    def angular_speed(self) -> tuple[Float64, Float64]:
        """Return times (M,) and the angular speed in rad/s between consecutive poses."""
        gap = np.diff(self.times)
        consecutive = gap <= _MAX_GAP * self.interval
        rotation = np.asarray(se3.angle(se3.inverse(self.poses[:-1]) @ self.poses[1:]))
        midpoints = 0.5 * (self.times[:-1] + self.times[1:])
        return midpoints[consecutive], (rotation / np.maximum(gap, 1e-12))[consecutive]


@dataclass(frozen=True, eq=False)
class HandEye:
    """Extrinsic calibration of a second camera b relative to a first one, a.

    Attributes
    ----------
    T_a_b, covariance
        (4, 4), and (6, 6) of its right perturbation.
    T_world_other
        (4, 4) from b's world to a's.
    time_offset_s, time_sigma_s
        To be added to b's timestamps.
    """

    T_a_b: Float64
    covariance: Float64
    T_world_other: Float64
    time_offset_s: float
    time_sigma_s: float


def clock_of(a: Track, b: Track) -> Lag | None:
    """Return the offset to add to b's timestamps, by the angular speeds; see `lag_between`."""
    return lag_between(*a.angular_speed(), *b.angular_speed())


def hand_eye(a: Track, b: Track, time_offset_s: float, *, common_world: bool = False) -> HandEye:
    """Fit two trajectories of a rig.

    Parameters
    ----------
    time_offset_s
        Initial value.
    common_world
        Whether both trajectories are in a common world frame already.

    Raises
    ------
    RegistrationError
        If there are too few common poses.
    """
    X, Y = _initial_estimate(a, b, time_offset_s, common_world=common_world)
    return _Fit(a, b, X, Y, time_offset_s).solve(common_world=common_world)


def combined(free: HandEye, common: HandEye, systematic: Float64) -> HandEye:
    """Return the weighted mean of two fits of the same poses, without and with a common world.

    The common world only adds information. So the random errors of its fit are in the other one,
    too, and what that has beyond is independent of them (Hausman, 1978): the difference tells of
    the systematic errors. The covariance is scaled by the Birge ratio (Birge, 1932) if the fits
    disagree by more than the covariances of both.

    Parameters
    ----------
    free, common
        Without and with a common world.
    systematic
        (6, 6) covariance of the errors of `common` by a deformed world.
    """
    difference = se3.log(se3.inverse(common.T_a_b) @ free.T_a_b)
    values, vectors = np.linalg.eigh(free.covariance - common.covariance)
    beyond = (vectors * np.maximum(values, 0.0)) @ vectors.T
    gain = systematic @ np.linalg.pinv(beyond + systematic, hermitian=True)
    total = free.covariance + common.covariance + systematic
    ratio = float(difference @ np.linalg.pinv(total, hermitian=True) @ difference) / len(difference)
    C = common.covariance + systematic - gain @ systematic
    return replace(
        common,
        T_a_b=np.asarray(se3.orthonormalise(common.T_a_b @ se3.exp(gain @ difference)), np.float64),
        covariance=np.asarray(0.5 * (C + C.T) * max(ratio, 1.0), np.float64),
    )


def common_poses(a: Track, b: Track, offset: float) -> tuple[Float64, Float64, Float64]:
    """Return the times of a's poses at which b has a pose too, and the poses of both."""
    T_b, valid = b.at(a.times - offset)
    if valid.sum() < _MIN_COMMON:
        raise RegistrationError(
            f"only {valid.sum()} poses of both cameras are of one time",
            remedy="record all cameras at the same time",
        )
    return a.times[valid], a.poses[valid], T_b[valid]


def _initial_estimate(
    a: Track, b: Track, offset: float, *, common_world: bool
) -> tuple[Float64, Float64]:
    """Return X and Y by Tsai and Lenz, from relative motions over several spans."""
    _, T_a, T_b = common_poses(a, b, offset)
    if common_world:
        return median_pose(se3.inverse(T_a) @ T_b), np.eye(4)
    motions_a, motions_b = [], []
    for span in _SPANS:
        step = max(1, round(span * len(T_a)))
        motions_a.append(se3.inverse(T_a[:-step]) @ T_a[step:])
        motions_b.append(se3.inverse(T_b[:-step]) @ T_b[step:])
    A, B = np.concatenate(motions_a), np.concatenate(motions_b)
    u, v = se3.so3_log(A[:, :3, :3]), se3.so3_log(B[:, :3, :3])
    # Small angles only: near pi the axis flips.
    small = np.linalg.norm(u, axis=1) < 2.5
    R = se3.nearest_rotation(u[small].T @ v[small])
    M = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    d = (B[:, :3, 3] @ R.T - A[:, :3, 3]).ravel()
    # Prior for directions that the motion does not constrain: the cameras are close together.
    t = np.linalg.solve(M.T @ M + 1e-4 * len(A) * np.eye(3), M.T @ d)
    X = se3.pose(R, t)
    return X, median_pose(T_a @ X @ se3.inverse(T_b))


def median_pose(poses: Float64) -> Float64:
    """Return the component-wise median of nearby poses (N, 4, 4), in their tangent space."""
    centre = poses[len(poses) // 2]
    for _ in range(10):
        deviations = se3.log(se3.inverse(centre) @ poses)
        centre = centre @ se3.exp(np.median(deviations, axis=0))
    return np.asarray(se3.orthonormalise(centre), np.float64)


class _Fit:
    """Gauss-Newton over X, Y and the clock, with robust weights."""

    def __init__(self, a: Track, b: Track, X: Float64, Y: Float64, offset: float) -> None:
        self.a, self.b = a, b
        self.X, self.Y, self.offset = X, Y, offset
        # Steps of derivatives: by the time, to the poses before and after.
        half_interval = 0.5 * min(a.interval, b.interval) / _TIME_UNIT
        self.steps = np.array([*[0.01] * 12, half_interval])

    def moved(self, step: Float64) -> tuple[Float64, Float64, float]:
        """Return X, Y and the time offset after a step (13,), in units."""
        X = se3.orthonormalise(self.X @ se3.exp(step[:6] * projective.UNITS))
        Y = se3.orthonormalise(self.Y @ se3.exp(step[6:12] * projective.UNITS))
        return X, Y, self.offset + float(step[12]) * _TIME_UNIT

    def linearised(self, free: Intp) -> tuple[Float64, Float64, Float64]:
        """Return derivatives (N, 6, F) by the free unknowns, residuals (N, 6) in units, and times.

        The residuals are log((T_a X)^-1 Y T_b) at the common times.
        """
        times, T_a, _ = common_poses(self.a, self.b, self.offset)

        def residuals(step: Float64) -> Float64:
            X, Y, offset = self.moved(step)
            T_b, _ = self.b.at(times - offset)
            return np.asarray(se3.log(se3.inverse(T_a @ X) @ Y @ T_b) / projective.UNITS)

        both = [residuals(step) - residuals(-step) for step in np.diag(self.steps)[free]]
        J = np.stack(both, axis=2) / (2 * self.steps[free])
        return J, residuals(np.zeros(13)), times

    def solve(self, *, common_world: bool) -> HandEye:
        """Iterate to convergence."""
        free = np.r_[0:6, 12] if common_world else np.arange(13)
        for _ in range(_ITERATIONS):
            J, e, _ = self.linearised(free)
            sigma = _sigma(e)
            w = _weights(e, sigma) / sigma**2
            H = _weighted_product(J, w, J)
            g = _weighted_product(J, w, e[..., None])[:, 0]
            step = np.zeros(13)
            step[free] = -np.linalg.solve(H + np.diag(1e-9 * H.diagonal() + 1e-6), g)
            step[12] = np.clip(step[12], -self.steps[12], self.steps[12])
            self.X, self.Y, self.offset = self.moved(step)
            if np.abs(step).max() < _CONVERGENCE:
                break
        J, e, times = self.linearised(free)
        C = _covariance(J, e, times, _sigma(e))
        units = np.outer(projective.UNITS, projective.UNITS)
        time_sigma_s = float(np.sqrt(C[-1, -1])) * _TIME_UNIT
        return HandEye(self.X, C[:6, :6] * units, self.Y, self.offset, time_sigma_s)


def _sigma(e: Float64) -> Float64:
    """Return the robust sigma (6,) of the residuals, isotropic in position and in rotation."""
    by_axis = np.median(np.abs(e), axis=0) / MEDIAN_OF_NORMAL
    by_kind = [np.sqrt((by_axis[:3] ** 2).mean())] * 3 + [np.sqrt((by_axis[3:] ** 2).mean())] * 3
    return np.maximum(by_kind, _MIN_SIGMA)


def _weights(e: Float64, sigma: Float64) -> Float64:
    """Return Tukey's biweights (N, 6) of the residual of each pose."""
    ratio = ((e / sigma) ** 2).mean(1) / _TUKEY**2
    return np.repeat(tukey.weights(ratio)[:, None], 6, axis=1)


def _covariance(J: Float64, e: Float64, times: Float64, sigma: Float64) -> Float64:
    """Return the covariance of the unknowns, in units, for errors correlated in time."""
    w = _weights(e, sigma) / sigma**2
    H = _weighted_product(J, w, J)
    correlation_time = _correlation_time(e / sigma, times, H.shape[0] / 6)
    correlation = np.exp(-2 * np.abs(times[:, None] - times[None]) / correlation_time)
    # Degrees of freedom: number of independent errors minus unknowns.
    independent = 6 * max((times[-1] - times[0]) / correlation_time, 1.0)
    freedom = max(independent - H.shape[0], 6.0)
    weighted = J * (w * sigma)[..., None]
    correlated = np.tensordot(correlation, weighted, 1)
    B = independent / freedom * np.tensordot(weighted, correlated, ((0, 1), (0, 1)))
    if H.shape[0] > 7:  # two world frames
        H[:6, :6] -= _spurious_information(w, sigma)
    values, vectors = np.linalg.eigh(H)
    bread = (vectors / np.maximum(values, _UNCONSTRAINED_SIGMA**-2)) @ vectors.T
    weak = vectors[:, values < _UNCONSTRAINED_SIGMA**-2]
    # For the six unknowns of a pose, and for the clock alone.
    inflation = np.sqrt(
        [_small_sample_factor(6, freedom)] * (len(H) - 1) + [_small_sample_factor(1, freedom)]
    )
    C = (
        np.outer(inflation, inflation) * (bread @ B @ bread)
        + _UNCONSTRAINED_SIGMA**2 * weak @ weak.T
    )
    return np.asarray(0.5 * (C + C.T), np.float64)


def _small_sample_factor(unknowns: int, freedom: float) -> float:
    """Return the factor on variances by which the 95 % ellipsoid of unknowns is larger.

    With few degrees of `freedom` it is that of the F distribution instead of chi-square.
    """
    ratio = stats.f.ppf(0.95, unknowns, freedom) / stats.chi2.ppf(0.95, unknowns)
    return float(unknowns * ratio)


def _spurious_information(w: Float64, sigma: Float64) -> Float64:
    """Return the information (6, 6) on X that noise of the poses alone would provide.

    Noise (tau, omega) of T_b changes the derivative of a residual with respect to (rho, phi) of X,
    relative to that of Y, by omega x rho + tau x phi in position and omega x phi in rotation. For
    instance, a rig that rotates about one axis appears to rotate about the others as well.

    Parameters
    ----------
    w
        (N, 6) weights of the residuals.
    sigma
        (6,) standard deviation of the residuals, in units.
    """
    position, rotation = w[:, :3].sum() / 3, w[:, 3:].sum() / 3
    tau, omega = 2 * (np.radians(sigma[[0, 3]]) ** 2)
    return np.diag([omega * position] * 3 + [tau * position + omega * rotation] * 3)


def _weighted_product(J: Float64, w: Float64, K: Float64) -> Float64:
    """Return the sum of J^T w K over all residuals."""
    return np.asarray(np.tensordot(J * w[..., None], K, ((0, 1), (0, 1))), np.float64)


def _correlation_time(e: Float64, times: Float64, unknowns: float) -> float:
    """Return the correlation time of errors, s: the integral of the residuals' autocorrelation.

    It is corrected for the errors that a fit absorbs: at all lags about as many independent ones as
    it has `unknowns` per axis. As a short time understates errors, the upper 95 % bound is returned
    (by Bartlett's standard error).
    """
    interval = float(np.median(np.diff(times)))
    power = float((e**2).sum())
    correlations = []
    for k in range(1, max(len(e) // 4, 2)):
        correlation = float((e[:-k] * e[k:]).sum()) / max(power, 1e-12)
        if correlation <= 0:
            break
        correlations.append(correlation)
    uncorrected = 1 + 2 * sum(correlations)
    bias = min(unknowns * uncorrected / len(e) + _BOUND_SIGMAS * np.sqrt(uncorrected / e.size), 0.5)
    return float(1 + 2 * sum((s + bias) / (1 + bias) for s in correlations)) * interval
