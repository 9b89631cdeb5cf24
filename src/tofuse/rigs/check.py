"""Check whether a camera of a rig was moved: a new calibration against that of its file.

Under the null hypothesis the motion xi of a camera from its pose in the file to the new one is
normally distributed with the sum of both covariances, and xi^T C^-1 xi is chi-square with six
degrees of freedom. Systematic errors of the ranges, such as multipath, recur in the same scene;
there the covariances of random errors alone apply. If the first camera was moved, all others appear
moved: if most do, another camera is the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.recordings.rig import Rig, RigCamera

# Significance level: probability of a false alarm for a whole rig.
LEVEL = 0.01


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """The result for one camera of a rig.

    Attributes
    ----------
    name
        Its name.
    T_before_after
        (4, 4) its motion, in its previous frame; None if it could not be placed.
    chance
        p-value: probability of at least this motion for a camera that was not moved.
    moved
        Whether the motion is significant.
    chance_elsewhere
        The same if the scene is not that of the calibration, so that systematic errors differ.
    sigma_m, sigma_rad
        Standard deviation of the motion along the direction where it is largest.
    reason
        Why there is no result; empty otherwise.
    """

    name: str
    T_before_after: Float64 | None
    chance: float
    moved: bool
    chance_elsewhere: float = 1.0
    sigma_m: float = np.nan
    sigma_rad: float = np.nan
    reason: str = ""

    @property
    def distance_m(self) -> float:
        """How far it was moved."""
        T = self.T_before_after
        return float("nan") if T is None else float(np.linalg.norm(T[:3, 3]))

    @property
    def angle_rad(self) -> float:
        """How far it was turned."""
        return (
            float("nan") if self.T_before_after is None else float(se3.angle(self.T_before_after))
        )


def compare_in_scene(stated: Rig, found: Rig, level: float = LEVEL) -> list[CameraMotion]:
    """As `compare`, for two calibrations in one scene, where systematic errors recur."""
    anywhere = compare(stated, found, level)
    return [
        replace(moved, chance_elsewhere=other.chance)
        for moved, other in zip(
            compare(_random_only(stated), _random_only(found), level), anywhere, strict=True
        )
    ]


def _random_only(rig: Rig) -> Rig:
    """Return the rig with the covariances of random errors, as far as they are known."""
    return replace(
        rig,
        cameras=tuple(
            c if c.random_covariance is None else replace(c, covariance=c.random_covariance)
            for c in rig.cameras
        ),
    )


def compare(stated: Rig, found: Rig, level: float = LEVEL) -> list[CameraMotion]:
    """Compare a rig with a new calibration, camera by camera in the order of `stated`.

    Parameters
    ----------
    stated, found
        The rig of the file and the new one; cameras are identified by their names.
    level
        Probability of a false alarm for the whole rig.
    """
    shared = [c for c in stated.cameras if found.camera(c.name) is not None]
    out: list[CameraMotion] = []
    knocked: dict[str, CameraMotion] = {}
    if len(shared) > 1:
        # Bonferroni correction for one test per camera.
        limit = level / (len(shared) - 1)
        reference = _reference(shared, found, limit)
        knocked = {c.name: _moved(c, reference, found, limit) for c in shared}
    for camera in stated.cameras:
        if camera.name in knocked:
            out.append(knocked[camera.name])
            continue
        why = found.unplaced.get(camera.name, "")
        out.append(CameraMotion(camera.name, None, 1.0, False, reason=why or "no recording of it"))
    return out


def _reference(shared: Sequence[RigCamera], found: Rig, limit: float) -> RigCamera:
    """Return the camera that the others are compared with.

    The first, unless more than half of the others appear moved relative to it: then the one
    relative to which the fewest do.
    """

    def moved(reference: RigCamera) -> int:
        return sum(_moved(c, reference, found, limit).moved for c in shared)

    if 2 * moved(shared[0]) <= len(shared) - 1 or len(shared) < 3:
        return shared[0]
    return min(shared, key=moved)


def _moved(camera: RigCamera, reference: RigCamera, found: Rig, limit: float) -> CameraMotion:
    """Test the motion of a camera relative to a reference."""
    if camera.name == reference.name:
        return CameraMotion(camera.name, np.eye(4), 1.0, False, sigma_m=0.0, sigma_rad=0.0)
    before, C_before = _relative(reference, camera)
    now, now_reference = found.camera(camera.name), found.camera(reference.name)
    assert now is not None
    assert now_reference is not None
    after, C_after = _relative(now_reference, now)
    T = np.asarray(se3.inverse(before) @ after, np.float64)
    xi = se3.log(T)
    # The covariance of the file, transformed from the previous frame of the camera to the new one.
    A = se3.adjoint(se3.inverse(T))
    C = A @ C_before @ A.T + C_after
    chance = float(chi2.sf(xi @ np.linalg.pinv(C, hermitian=True) @ xi, 6))
    position, rotation = (
        float(np.sqrt(max(np.linalg.eigvalsh(C[part, part])[-1], 0)))
        for part in (slice(3), slice(3, 6))
    )
    return CameraMotion(camera.name, T, chance, chance < limit, chance, position, rotation)


def _relative(reference: RigCamera, camera: RigCamera) -> tuple[Float64, Float64]:
    """Return T_reference_camera (4, 4) and its covariance (6, 6).

    The covariances of two cameras are assumed independent, which is conservative: shared errors,
    those of the first camera, cancel.
    """
    T = np.asarray(se3.inverse(reference.T_rig_camera) @ camera.T_rig_camera, np.float64)
    A = se3.adjoint(se3.inverse(T))
    return T, np.asarray(A @ reference.covariance @ A.T + camera.covariance, np.float64)
