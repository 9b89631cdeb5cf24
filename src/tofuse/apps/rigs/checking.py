"""Check whether a camera of a rig was moved: compare a new calibration with that of the file.

Under the null hypothesis the motion xi of a camera from its pose in the file to the new one is
normally distributed with the sum of both covariances, and xi^T C^-1 xi is chi-square with six
degrees of freedom. Systematic range errors, for instance from multipath, recur in the same scene;
there only the covariances of random errors apply. If the first camera was moved, all others appear
moved: if most do, another camera is the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.formats.rigs import Rig, RigCamera

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
        The same for a scene other than that of the calibration, where systematic errors differ.
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
        """Distance by which it was moved, m."""
        T = self.T_before_after
        return float("nan") if T is None else float(np.linalg.norm(T[:3, 3]))

    @property
    def angle_rad(self) -> float:
        """Angle by which it was rotated, rad."""
        return (
            float("nan") if self.T_before_after is None else float(se3.angle(self.T_before_after))
        )


def compare_in_scene(previous: Rig, current: Rig) -> list[CameraMotion]:
    """Apply `compare` to two calibrations in one scene, where systematic errors recur."""
    anywhere = compare(previous, current)
    return [
        replace(motion, chance_elsewhere=other.chance)
        for motion, other in zip(
            compare(_random_only(previous), _random_only(current)), anywhere, strict=True
        )
    ]


def _random_only(rig: Rig) -> Rig:
    """Return the rig with the covariances of random errors, where they are known."""
    return replace(
        rig,
        cameras=tuple(
            c if c.random_covariance is None else replace(c, covariance=c.random_covariance)
            for c in rig.cameras
        ),
    )


def compare(previous: Rig, current: Rig, level: float = LEVEL) -> list[CameraMotion]:
    """Compare a rig with a new calibration, camera by camera in the order of `previous`.

    Parameters
    ----------
    previous, current
        The rig of the file and the new one; cameras are identified by their names.
    level
        Probability of a false alarm for the whole rig.
    """
    shared = [c for c in previous.cameras if current.camera(c.name) is not None]
    out: list[CameraMotion] = []
    motions: dict[str, CameraMotion] = {}
    if len(shared) > 1:
        # Bonferroni correction for one test per camera.
        limit = level / (len(shared) - 1)
        reference = _reference(shared, current, limit)
        motions = {c.name: _test_motion(c, reference, current, limit) for c in shared}
    for camera in previous.cameras:
        if camera.name in motions:
            out.append(motions[camera.name])
            continue
        alone = "the pose of no other camera was found"
        reason = current.unplaced.get(camera.name, alone if camera in shared else "no recording")
        out.append(CameraMotion(camera.name, None, 1.0, False, reason=reason))
    return out


def _reference(shared: Sequence[RigCamera], current: Rig, limit: float) -> RigCamera:
    """Return the camera that the others are compared with.

    This is the first, unless more than half of the others appear moved relative to it: then the one
    relative to which the fewest do.
    """

    def count_moved(reference: RigCamera) -> int:
        return sum(_test_motion(c, reference, current, limit).moved for c in shared)

    if 2 * count_moved(shared[0]) <= len(shared) - 1 or len(shared) < 3:
        return shared[0]
    return min(shared, key=count_moved)


def _test_motion(
    camera: RigCamera, reference: RigCamera, current: Rig, limit: float
) -> CameraMotion:
    """Test the motion of a camera relative to a reference."""
    if camera.name == reference.name:
        return CameraMotion(camera.name, np.eye(4), 1.0, False, sigma_m=0.0, sigma_rad=0.0)
    T_before, C_before = _relative(reference, camera)
    camera_now, reference_now = current.camera(camera.name), current.camera(reference.name)
    assert camera_now is not None
    assert reference_now is not None
    T_after, C_after = _relative(reference_now, camera_now)
    T = np.asarray(se3.inverse(T_before) @ T_after, np.float64)
    xi = se3.log(T)
    # The covariance of the file, transformed from the previous frame of the camera to the new one.
    A = se3.adjoint(se3.inverse(T))
    C = A @ C_before @ A.T + C_after
    if not np.isfinite(C).all():
        reason = f"it shares no surface with {reference.name}"
        return CameraMotion(camera.name, None, 1.0, False, reason=reason)
    chance = float(chi2.sf(xi @ np.linalg.pinv(C, hermitian=True) @ xi, 6))
    position, rotation = se3.largest_sigmas(C).tolist()
    return CameraMotion(camera.name, T, chance, chance < limit, chance, position, rotation)


def _relative(reference: RigCamera, camera: RigCamera) -> tuple[Float64, Float64]:
    """Return T_reference_camera (4, 4) and its covariance (6, 6).

    The covariances of two cameras are assumed independent, which is conservative: shared errors,
    those of the first camera, cancel.
    """
    T = np.asarray(se3.inverse(reference.T_rig_camera) @ camera.T_rig_camera, np.float64)
    A = se3.adjoint(se3.inverse(T))
    return T, np.asarray(A @ reference.covariance @ A.T + camera.covariance, np.float64)
