"""How well the distance of two points of a model is known.

Errors of the poses move a point with the keyframes that saw it, and points that the same ones saw
move together: only the joint covariance of the keyframes says how far apart two points are. A wrong
focal length stretches what each keyframe saw, a wrong depth scale everything, multipath moves each
point along its line of sight, and of the disagreement of views a part remains in their mean.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from tofuse.apps.certainty.known import Known
from tofuse.engine.arrays import Float32, Float64, UInt8
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Frame
from tofuse.engine.geometry import KdTree
from tofuse.engine.normal import OF_95_PERCENT
from tofuse.engine.quality import pose_accuracy
from tofuse.engine.results import Reconstruction

# Standard deviations of what no comparison of views shows, as fractions of the range: of the depth
# scale, as data sheets of depth cameras state, and of what multipath and smoothing add from place
# to place, as in simulated recordings.
_SCALE, _RANGE = 0.01, 0.005
# Small motions of a keyframe whose pose is not bounded: m, and rad.
_UNBOUNDED = np.array([30.0] * 3 + [10.0] * 3)
# Reasons for which the poses have no bound, although their covariance is small.
_UNTRUSTED = {"open_motion", "ambiguous_steps", "range_changes", "repeated_images"}


@dataclass(frozen=True)
class Length:
    """The distance of two points of a model.

    Attributes
    ----------
    length_m
        The distance.
    bound_m
        Half of its 95 % interval; inf if no measurement bounds it.
    causes_m
        The parts of `bound_m`, whose squares add up: errors of the `poses`, of the `focal` length,
        of all ranges (`offset`), of the depth `scale`, of the `range` at each end, and of the
        `surface`.
    """

    length_m: float
    bound_m: float
    causes_m: dict[str, float]

    @property
    def interval_m(self) -> tuple[float, float]:
        """The 95 % interval."""
        return max(self.length_m - self.bound_m, 0.0), self.length_m + self.bound_m

    def __repr__(self) -> str:
        return f"Length: {self}"

    def __str__(self) -> str:
        if not np.isfinite(self.bound_m):
            return f"{1e3 * self.length_m:.1f} mm, not bounded"
        return f"{1e3 * self.length_m:.1f} ± {1e3 * self.bound_m:.1f} mm (95 %)"


@dataclass(frozen=True, eq=False)
class LengthErrors:
    """What the errors of all lengths follow from.

    Attributes
    ----------
    centre
        (3,) mean of the keyframes' positions in the world, which the rest is relative to.
    points
        (P, 3) of the surfaces.
    weights
        (P, K) weights of the keyframes that saw each, up to a factor.
    cameras
        (K, 6) position and viewing direction of each keyframe.
    sights
        (P, 3) mean line of sight to each point, over the cosine of its angle to the normal.
    covariance
        (6K, 6K) of small motions of the keyframes, translation and rotation about the centre, times
        the square of the quantile of a 95 % interval.
    bounds
        95 % bounds of the errors of the camera, and of the distance of the surfaces of two views.
    """

    centre: Float64
    points: Float32
    weights: UInt8
    cameras: Float32
    sights: Float32
    covariance: Float32
    bounds: Mapping[str, float]

    @classmethod
    def of(cls, result: Reconstruction, frame: Frame | None) -> Self | None:
        """Return those of a result, with the field of view of one of its frames, if known.

        None where it has no surface of a single camera, or its poses no covariance.
        """
        accuracy = result.diagnostics.accuracy
        if result.mesh is None or result.recording.get("rig") or not accuracy.assessed:
            return None
        known = Known.of_result(result, frame)
        if known is None:
            return None
        seen = known.seen.pixels.any(0)
        points, pixels = known.surfaces.points[seen], known.seen.pixels.T[seen]
        if not len(points):
            return None
        weights = np.ceil(254 * pixels / pixels.max(1, keepdims=True)).astype(np.uint8)
        cameras = known.poses[:, :3, [3, 2]].swapaxes(1, 2).reshape(-1, 6)
        # Pixels are the cosine over the squared depth, information is that over its fourth power.
        cosines = (pixels**2).sum(1) / known.seen.information.T[seen].sum(1)
        sights = points - pixels @ cameras[:, :3] / pixels.sum(1, keepdims=True)
        sigmas = {"scale": _SCALE, "range": _RANGE, "surface": accuracy.surface_m or 0.0}
        sigmas |= accuracy.camera_sigmas
        quantile = float(stdtrit(accuracy.degrees, 0.975))
        return cls(
            known.centre,
            points,
            weights,
            cameras.astype(np.float32),
            (sights / cosines[:, None]).astype(np.float32),
            (quantile**2 * _covariance(known, result)).astype(np.float32),
            {name: OF_95_PERCENT * sigma for name, sigma in sigmas.items()},
        )

    @cached_property
    def _tree(self) -> KdTree:
        return KdTree(self.points.astype(np.float64))

    def between(self, a: ArrayLike, b: ArrayLike) -> Length:
        """Return the distance of two points (3,) of the model, in the world.

        Raises
        ------
        InputError
            If they are not two different points.
        """
        try:
            ends = np.array([a, b], float)
        except (TypeError, ValueError):
            ends = np.zeros(0)
        if ends.shape != (2, 3) or not np.isfinite(ends).all() or not np.ptp(ends, axis=0).any():
            raise InputError("are not two different points (3,)", where="the ends of the length")
        ends -= self.centre
        length = float(np.linalg.norm(ends[0] - ends[1]))
        e = (ends[0] - ends[1]) / length
        nearest, _ = self._tree.nearest(ends)
        w = self.weights[nearest] / self.weights[nearest].sum(1, keepdims=True, dtype=float)
        signed = w * [[1], [-1]]
        h = signed.T @ np.concatenate([np.tile(e, (2, 1)), np.cross(ends, e)], 1)
        arm, axis = ends[:, None] - self.cameras[:, :3], self.cameras[:, 3:]
        effects = {
            # Across its axis; the poses follow, so that also views of one end each fit together.
            "focal": length * (1 - w.mean(0) @ (axis @ e) ** 2),
            "offset": (signed * (arm @ e) / np.linalg.norm(arm, axis=2)).sum(),
            "scale": length,
            "range": np.linalg.norm(self.sights[nearest] @ e),
            "surface": np.linalg.norm(w) / np.sqrt(2),
        }
        causes = {"poses": float(np.sqrt(max(h.ravel() @ self.covariance @ h.ravel(), 0.0)))}
        causes |= {n: self.bounds.get(n, 0.0) * abs(float(size)) for n, size in effects.items()}
        bound = float(np.linalg.norm([*causes.values()]))
        return Length(length, bound if bound < max(length, 1.0) else np.inf, causes)


def _covariance(known: Known, result: Reconstruction) -> Float64:
    """(6K, 6K) joint covariance of the keyframes, with all errors that the bound includes.

    Its mean square is that of the causes of the result's bound. Motions of all keyframes together
    change no length, and are removed.
    """
    accuracy, C = result.diagnostics.accuracy, known.covariance
    k = len(known.poses)
    records = {r.index: r.covariance for r in result.diagnostics.frames}
    unbounded = np.isin(known.frames, accuracy.unbounded)
    total = sum(cause**2 for cause in accuracy.causes_m.values())
    lost = unbounded[:, None] & unbounded & (known.parts[:, None] == known.parts)
    codes = {reason.code for reason in result.diagnostics.reasons}
    if total:
        C = C * (total / known.mean_square)
    elif unbounded.all() or not unbounded.any() or codes & _UNTRUSTED:
        lost = np.eye(k, dtype=np.bool_)
    else:  # the covariances of the others include all errors
        stated = [records.get(int(i)) for i in known.frames]
        by_graph = known.position_variances
        ratios = [
            float(np.trace(S[:3, :3])) / v
            for S, v, left_out in zip(stated, by_graph, unbounded, strict=True)
            if S is not None and not left_out and v > 0
        ]
        C = C * (np.median(ratios) / pose_accuracy.factor_of(accuracy.degrees) if ratios else 1.0)
    C = C + np.kron(lost, np.diag(_UNBOUNDED**2))
    # Less the mean motion, which is that of all.
    blocks = C.reshape(k, 6, k, 6)
    blocks = blocks - blocks.mean(0, keepdims=True)
    blocks -= blocks.mean(2, keepdims=True)
    return blocks.reshape(6 * k, 6 * k)
