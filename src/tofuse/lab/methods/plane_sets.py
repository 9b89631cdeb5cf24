"""Registration by the planes of two range images (Mure-Dubois and Hügli 2008)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Annotated, ClassVar

import numpy as np

from tofuse.engine.alignment import Registrar, Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.parts import part
from tofuse.engine.search import Plane, detect_planes, pair_agreement
from tofuse.engine.views import PreparedView, SurfaceOptions, prepare_view

# Min sine of the angle between two normals that determine a rotation, and min volume spanned by
# three that determine a translation.
_MIN_SINE, _MIN_VOLUME = 0.3, 0.15
# Pose candidates ranked by the agreement of the images.
_MAX_CANDIDATES = 15
# Min mean square of the normals along a direction that counts as constrained.
_MIN_CONSTRAINT = 0.005


@part("registration", "planes")
@dataclass(frozen=True)
class PlaneSets(Bounded, Registrar):
    """RANSAC planes of both images, matched by the angles between them.

    Two pairs of planes determine a rotation, by their normals; three a translation, by their
    offsets. Among the poses under which most planes match, the agreement of both images decides
    (`agreement`). Directions not constrained by the matched planes, such as along a corridor, are
    reported in `unobservable` and keep the guess.

    Attributes
    ----------
    planes
        Maximum number per view.
    min_fraction
        Minimum fraction of a view's points on a plane.
    sigmas, thickness
        Inlier distance of a plane: standard deviations, plus a fraction of the depth.
    angle, offset
        Tolerances of matching planes: rad, and a fraction of the views' depth.
    """

    planes: Annotated[int, Bounds(1, 20)] = 8
    min_fraction: Annotated[float, Bounds(0, 1, exclusive=True)] = 0.03
    sigmas: Annotated[float, Bounds(0, 100, exclusive=True)] = 2.5
    thickness: Annotated[float, Bounds(0, 100, exclusive=True)] = 0.005
    angle: Annotated[float, Bounds(0, 100, exclusive=True)] = 0.1
    offset: Annotated[float, Bounds(0, 100, exclusive=True)] = 0.03
    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; points are the source's planes, correspondences the matches.

        Raises
        ------
        RegistrationError
            If a view has no plane, or the images contradict all poses.
        """
        s, t = self._prepare(source), self._prepare(target)
        a, b = self._planes(s, rng), self._planes(t, rng)
        for view, planes in ((source, a), (target, b)):
            if not planes:
                raise RegistrationError("has no planes", where=f"frame {view.index}")
        depth = 0.5 * (s.depth + t.depth)
        poses = _distinct(self._poses(a, b, guess, depth), depth)[:_MAX_CANDIDATES]
        if not poses:
            raise RegistrationError("no plane of one view matches one of the other")
        agreements = [pair_agreement.agreement(s, t, T).score for _, _, T in poses]
        scores = [
            fraction + score for (fraction, _, _), score in zip(poses, agreements, strict=True)
        ]
        best = max(range(len(poses)), key=lambda k: scores[k])
        if agreements[best] <= 0:
            raise RegistrationError(
                f"{len(poses[best][1])} planes match under a pose that what both images saw "
                "contradicts"
            )
        rival = max((score for k, score in enumerate(scores) if k != best), default=0.0)
        _, pairs, T = poses[best]
        margin = scores[best] - max(rival, 0.0)
        return self._registration(a, b, pairs, T, len(poses), depth, margin)

    def _prepare(self, view: Frame) -> PreparedView:
        if not isinstance(view, RangeFrame):
            raise RegistrationError("is not an image", where=f"frame {view.index}")
        return prepare_view(view, SurfaceOptions())

    def _planes(self, view: PreparedView, rng: np.random.Generator) -> list[Plane]:
        return detect_planes(
            view,
            rng,
            max_planes=self.planes,
            min_fraction=self.min_fraction,
            sigmas=self.sigmas,
            thickness=self.thickness,
        )

    def _poses(
        self, a: list[Plane], b: list[Plane], guess: Float64, depth: float
    ) -> list[tuple[float, list[tuple[int, int]], Float64]]:
        """Matched fraction, matched pairs and T_target_source of each candidate, best first."""
        found = []
        normals = np.stack([plane.normal for plane in a]), np.stack([plane.normal for plane in b])
        for R in _rotations(*normals, guess[:3, :3], self.angle):
            cosine = (normals[0] @ R.T) @ normals[1].T
            aligned = list(zip(*np.nonzero(cosine > np.cos(self.angle)), strict=True))
            for subset in _independent(aligned, normals[1]):
                T = _pose(a, b, subset, R, guess)
                pairs = self._match_planes(a, b, T, depth)
                if len(pairs) < len(subset):
                    continue
                T = _pose(a, b, pairs, R, guess)
                fraction = sum(min(a[i].fraction, b[j].fraction) for i, j in pairs)
                found.append((float(fraction), pairs, T))
        found.sort(key=lambda candidate: -candidate[0])
        return found

    def _match_planes(
        self, a: list[Plane], b: list[Plane], T: Float64, depth: float
    ) -> list[tuple[int, int]]:
        """Pairs of coincident planes, each plane in at most one pair."""
        pairs: list[tuple[int, int]] = []
        for i, plane in enumerate(a):
            normal = T[:3, :3] @ plane.normal
            offset = plane.offset + float(normal @ T[:3, 3])
            best: int = -1
            lowest: float = 1.0
            for j, other in enumerate(b):
                angle_error = float(np.arccos(np.clip(normal @ other.normal, -1, 1))) / self.angle
                error = max(angle_error, abs(offset - other.offset) / (self.offset * depth))
                if error < lowest and all(j != m for _, m in pairs):
                    best, lowest = j, error
            if best >= 0:
                pairs.append((i, best))
        return pairs

    def _registration(
        self,
        a: list[Plane],
        b: list[Plane],
        pairs: list[tuple[int, int]],
        T: Float64,
        candidates: int,
        depth: float,
        margin: float,
    ) -> Registration:
        normals = np.stack([a[i].normal for i, _ in pairs])
        rotated = normals @ T[:3, :3].T
        offsets = np.array([a[i].offset for i, _ in pairs]) + rotated @ T[:3, 3]
        residual = offsets - np.array([b[j].offset for _, j in pairs])
        # The matching tolerance is three standard deviations.
        sigma_m, sigma_rad = self.offset * depth / 3, self.angle / 3
        information = np.zeros((6, 6))
        A_t, A_R = np.zeros((3, 3)), np.zeros((3, 3))
        for n in normals:
            A_t += np.outer(n, n)
            A_R += np.eye(3) - np.outer(n, n)
        information[:3, :3], information[3:, 3:] = (A_t / sigma_m**2, A_R / sigma_rad**2)
        unobservable = np.zeros((0, 6))
        for matrix, block in ((A_t, slice(0, 3)), (A_R, slice(3, 6))):
            values, vectors = np.linalg.eigh(matrix / len(normals))
            directions = np.zeros((int((values < _MIN_CONSTRAINT).sum()), 6))
            directions[:, block] = vectors[:, values < _MIN_CONSTRAINT].T
            unobservable = np.vstack([unobservable, directions])
        return Registration(
            T_target_source=T,
            converged=True,
            iterations=candidates,
            correspondences=len(pairs),
            points=len(a),
            error=float(np.abs(residual).sum() / (len(a) * self.offset * depth)),
            rms_m=float(np.sqrt((residual**2).mean())),
            information=information,
            unobservable=unobservable,
            margin=margin,
        )


def _rotations(a: Float64, b: Float64, guess: Float64, tolerance: float) -> Iterator[Float64]:
    """Rotations (3, 3) that align two normals of a (n, 3) with two of b (m, 3).

    If there are none, those nearest to the guess that align one.
    """
    angles_a, angles_b = (np.arccos(np.clip(x @ x.T, -1, 1)) for x in (a, b))
    for i, k in combinations(range(len(a)), 2):
        if np.sin(angles_a[i, k]) < _MIN_SINE:
            continue
        for j, m in permutations(range(len(b)), 2):
            if abs(angles_a[i, k] - angles_b[j, m]) < tolerance:
                yield _align_normals(np.stack([a[i], a[k]]), np.stack([b[j], b[m]]), guess)
    for i in range(len(a)):
        for j in range(len(b)):
            yield _align_normals(a[i : i + 1], b[j : j + 1], guess)


def _align_normals(a: Float64, b: Float64, prior: Float64) -> Float64:
    """Rotation (3, 3) that best aligns normals a (n, 3) with b (n, 3), close to `prior`.

    A small weight of `prior` regularises it.
    """
    return se3.nearest_rotation(b.T @ a + 1e-4 * prior)


def _independent(pairs: list[tuple[int, int]], normals: Float64) -> Iterator[list[tuple[int, int]]]:
    """Pairs of planes that constrain the translation: three, or two or one if not available."""
    found = False
    for count in (3, 2, 1):
        if count == 1 and found:
            return
        for subset in combinations(pairs, count):
            if len({i for i, _ in subset}) < count or len({j for _, j in subset}) < count:
                continue
            if _volume(normals[[j for _, j in subset]]) > _MIN_VOLUME:
                found = True
                yield list(subset)


def _volume(normals: Float64) -> float:
    """Volume, area or length spanned by unit normals (n, 3)."""
    return float(np.sqrt(max(np.linalg.det(normals @ normals.T), 0.0)))


def _pose(
    a: list[Plane], b: list[Plane], pairs: list[tuple[int, int]], R: Float64, guess: Float64
) -> Float64:
    """Least-squares pose (4, 4) of pairs of planes; keeps the guess where unconstrained."""
    weight = np.sqrt([min(a[i].fraction, b[j].fraction) for i, j in pairs])[:, None]
    source_normals, target_normals = (
        np.stack([planes[k].normal for k in indices])
        for planes, indices in zip((a, b), zip(*pairs, strict=True), strict=True)
    )
    T = se3.pose(_align_normals(weight * source_normals, weight * target_normals, R))
    rotated = source_normals @ T[:3, :3].T
    # offset in the target = offset in the source + normal . t
    offsets = np.array([b[j].offset - a[i].offset for i, j in pairs])
    t_guess = guess[:3, 3]
    residual = (offsets - rotated @ t_guess)[:, None]
    dt = np.linalg.lstsq(weight * rotated, weight * residual, rcond=np.sqrt(_MIN_CONSTRAINT))[0][
        :, 0
    ]
    T[:3, 3] = t_guess + dt
    return T


def _distinct(
    poses: list[tuple[float, list[tuple[int, int]], Float64]], depth: float
) -> list[tuple[float, list[tuple[int, int]], Float64]]:
    """The poses in their order, without near duplicates of better ones."""
    distinct: list[tuple[float, list[tuple[int, int]], Float64]] = []
    for candidate in poses:
        deltas = [se3.inverse(other[2]) @ candidate[2] for other in distinct]
        if all(np.linalg.norm(d[:3, 3]) > 0.05 * depth or se3.angle(d) > 0.1 for d in deltas):
            distinct.append(candidate)
        if len(distinct) == _MAX_CANDIDATES:
            break
    return distinct
