"""What is wrong with poses that contradict registrations, by likelihood.

Each hypothesis is linear in a few parameters: the errors x of the poses are B theta. With S the
covariance of the fitted poses (`pose_deviation`), the parameters minimise
Q = (x - B theta)^T S^-1 (x - B theta), and hypotheses are compared by the Bayesian information
criterion (Schwarz 1978), of which a Q of correct poses is the minimum.

| Kind | Errors of the poses | Parameters |
|---|---|---|
| scale | all positions, in proportion | 1 |
| time | the motion in a constant time | 1 |
| mount | a constant motion in the camera's frame, as of another point of the device | 6 |
| turning | steps turned in proportion to their length | 3 |
| drift | steps wrong in proportion to their length | 6 |
| jump | all poses from a view on, rigidly | 6, and the view |

A cause is named only if it explains most of the contradiction, is far more probable than no common
cause and than any other, and is small enough for linear errors. A jump must be that of one step:
steps that are all wrong resemble it, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.quality.pose_deviation import TYPICAL_RATIO, Deviation

Kind = Literal["scale", "time", "mount", "turning", "drift", "jump"]

# Differences of the criterion, twice the logarithm of a probability ratio: "very strong" and
# "strong" evidence (Kass and Raftery 1995).
_OVER_NONE, _OVER_OTHERS = 10.0, 6.0
# Fewest views on either side of a jump: fewer may be wrong by themselves.
_MIN_SIDE = 3
# Fraction of the contradiction that a cause explains.
_MOST = 2 / 3
# Largest rotation whose effect is about linear, rad. Error of the step of a jump, relative to that.
_MAX_ANGLE, _MAX_STEP_ERROR = 1.0, 0.5


@dataclass(frozen=True)
class Cause:
    """A cause of the errors of poses.

    Attributes
    ----------
    kind
        See the table above.
    text
        In words, with its size.
    frames
        Of a jump: the indices of the frames before and after it.
    explained
        Fraction of the contradiction that it explains.
    """

    kind: Kind
    text: str
    explained: float
    frames: tuple[int, int] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of `judge.json`."""
        return {
            "kind": self.kind,
            "text": self.text,
            "explained": self.explained,
            "frames": None if self.frames is None else list(self.frames),
        }


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """Errors (V, 6, p) of the poses per parameter, and the number of values chosen for it."""

    kind: Kind
    basis: Float64
    view: int = 0

    @property
    def parameters(self) -> int:
        """Number of parameters, including the view of a jump."""
        return self.basis.shape[2] + (self.kind == "jump")


def cause_of(found: Deviation, velocity: Float64) -> Cause | None:
    """Return the cause of a significant deviation, if one explains it.

    Parameters
    ----------
    found
        The deviation of the poses.
    velocity
        (V, 6) motion of the camera in its own frame at these views, m/s and rad/s; NaN if unknown.
    """
    if found.consistent:
        return None
    graph, n = found.fit.graph, found.fit.dof
    i, j = graph.edges.T
    A = se3.adjoint(se3.inverse(graph.poses[j]) @ graph.poses[i])
    W = graph.information

    def differences(x: Float64) -> Float64:
        """Errors (M, 6, ...) of the pairs by errors of their views."""
        return np.asarray(x[j] - np.einsum("mab,mb...->ma...", A, x[i]))

    e = differences(found.errors)
    We = np.einsum("mab,mb->ma", W, e)
    total = float((e * We).sum())
    floor = TYPICAL_RATIO * n

    def criterion(q: float, parameters: int) -> float:
        return n * float(np.log(max(q, floor) / n)) + parameters * float(np.log(n))

    results = []
    for hypothesis in _hypotheses(found, velocity):
        J = differences(hypothesis.basis)
        H = np.einsum("map,mab,mbq->pq", J, W, J, optimize=True)
        b = np.einsum("map,ma->p", J, We)
        theta = np.linalg.lstsq(H, b, rcond=1e-9)[0]
        q = total - float(b @ theta)
        results.append((criterion(q, hypothesis.parameters), q, hypothesis, theta))
    results.sort(key=lambda result: result[0])
    best, q, hypothesis, theta = results[0]
    others = [c for c, _, other, _ in results if other.kind != hypothesis.kind]
    explained = (total - max(q, floor)) / (total - floor)
    if (
        criterion(total, 0) - best < _OVER_NONE
        or min(others) - best < _OVER_OTHERS
        or explained < _MOST
        or not _is_possible(found, hypothesis, theta)
    ):
        return None
    frames = None
    if hypothesis.kind == "jump":
        frames = (int(graph.ids[hypothesis.view - 1]), int(graph.ids[hypothesis.view]))
    return Cause(hypothesis.kind, _words(hypothesis, theta, frames), explained, frames)


def _is_possible(found: Deviation, hypothesis: _Hypothesis, theta: Float64) -> bool:
    """Whether errors with parameters (p,) are about linear, and those of a jump are of one step."""
    if hypothesis.kind != "jump":
        return len(theta) == 1 or bool(np.linalg.norm(theta[-3:]) < _MAX_ANGLE)
    around = slice(hypothesis.view - 1, hypothesis.view + 1)
    fitted = found.fit.graph.poses[around]
    given = fitted @ se3.exp(found.errors[around])
    step, given_step = (se3.inverse(T[0]) @ T[1] for T in (fitted, given))
    units = np.array([1.0] * 3 + [found.fit.depth_m] * 3)
    remaining = units * (se3.log(se3.inverse(step) @ given_step) - theta)
    return bool(np.linalg.norm(remaining) < _MAX_STEP_ERROR * np.linalg.norm(units * theta))


def _hypotheses(found: Deviation, velocity: Float64) -> Iterator[_Hypothesis]:
    poses = found.fit.graph.poses
    n = len(poses)
    scaled = np.zeros((n, 6, 1))
    centred = poses[:, :3, 3] - poses[:, :3, 3].mean(0)
    scaled[:, :3, 0] = np.einsum("nji,nj->ni", poses[:, :3, :3], centred)
    yield _Hypothesis("scale", scaled)
    if np.isfinite(velocity).all():
        yield _Hypothesis("time", velocity[..., None])
    yield _Hypothesis("mount", np.tile(np.eye(6), (n, 1, 1)))
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    lengths = np.linalg.norm(steps[:, :3, 3], axis=1) + found.fit.depth_m * se3.angle(steps)
    lengths /= max(float(lengths.sum()), 1e-9)
    # An error of a step moves all later poses.
    moved = se3.adjoint(se3.inverse(poses)[:, None] @ poses[None])
    drift = np.zeros((n, 6, 6))
    for k, length in enumerate(lengths, 1):
        drift[k:] += length * moved[k:, k]
    yield _Hypothesis("turning", drift[..., 3:])
    yield _Hypothesis("drift", drift)
    for k in range(_MIN_SIDE, n - _MIN_SIDE + 1):
        jump = np.zeros((n, 6, 6))
        jump[k:] = moved[k:, k]
        yield _Hypothesis("jump", jump, k)


def _words(hypothesis: _Hypothesis, theta: Float64, frames: tuple[int, int] | None) -> str:
    size = theta if len(theta) == 6 else np.concatenate([np.zeros(3), np.resize(theta, 3)])
    moved, turned = np.linalg.norm(size[:3]), np.degrees(np.linalg.norm(size[3:]))
    angle = f"{float(f'{turned:.2g}'):g}\N{DEGREE SIGN}"  # not 2.2e+02
    by = f"{1e3 * moved:.0f} mm and {angle}"
    match hypothesis.kind:
        case "scale":
            return f"a wrong scale: lengths are {1 + theta[0]:.3g} times the true ones"
        case "time":
            late = "lag behind" if theta[0] < 0 else "are ahead of"
            return f"a time offset: the poses {late} the images by {1e3 * abs(theta[0]):.0f} ms"
        case "mount":
            return f"a wrong mount: the poses are of a point and directions {by} off the camera's"
        case "turning":
            return f"rotation drifts along the track, by {angle} in total"
        case "drift":
            return f"drift along the track, by {by} in total"
    assert frames is not None
    return f"a jump of {by} between frames {frames[0]} and {frames[1]}"
