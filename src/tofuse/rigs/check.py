"""Was a camera of a rig moved? The rig calibrated anew, against what its file says.

Under the hypothesis that nothing moved, the motion xi of a camera from where the file has it to
where it is found is normal with the sum of both covariances, and xi^T C^-1 xi is chi-square with
six degrees of freedom. A first camera that was moved would seem to move all others: where most
seem to have moved, they are compared with another one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.recordings.rig import Rig, RigCamera

# False alarms of a whole rig, and the chance below which a camera's motion is called certain.
LEVEL = 0.01


@dataclass(frozen=True, eq=False)
class Moved:
    """What became of one camera of a rig.

    Attributes
    ----------
    name
        What it is called.
    T_before_after
        (4, 4) its motion, in its frame as it was; None where it could not be found.
    chance
        Probability that a camera which has not moved seems to have moved as much.
    moved
        Whether it is said to have moved.
    sigma_m, sigma_rad
        Standard deviation of the motion along the direction where it is largest.
    reason
        Why nothing can be said; empty otherwise.
    """

    name: str
    T_before_after: Float64 | None
    chance: float
    moved: bool
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


def compare(stated: Rig, found: Rig, level: float = LEVEL) -> list[Moved]:
    """Compare a rig with what it is now, camera by camera in the order of `stated`.

    Parameters
    ----------
    stated, found
        The file's rig and the one calibrated anew; cameras are known by their names.
    level
        Chance that a rig in which nothing moved is said to have a moved camera.
    """
    shared = [c for c in stated.cameras if found.camera(c.name) is not None]
    out: list[Moved] = []
    knocked: dict[str, Moved] = {}
    if len(shared) > 1:
        # Each camera is asked: of how many tests, the level is kept for all together.
        limit = level / (len(shared) - 1)
        reference = _reference(shared, found, limit)
        knocked = {c.name: _moved(c, reference, found, limit) for c in shared}
    for camera in stated.cameras:
        if camera.name in knocked:
            out.append(knocked[camera.name])
            continue
        why = found.unplaced.get(camera.name, "")
        out.append(Moved(camera.name, None, 1.0, False, reason=why or "no recording of it"))
    return out


def _reference(shared: Sequence[RigCamera], found: Rig, limit: float) -> RigCamera:
    """The camera that the others are compared with.

    The first, unless more than half of the others seem to have moved from it: then it was the first
    that was moved, and the one is taken from which the fewest have.
    """

    def moved(reference: RigCamera) -> int:
        return sum(_moved(c, reference, found, limit).moved for c in shared)

    if 2 * moved(shared[0]) <= len(shared) - 1 or len(shared) < 3:
        return shared[0]
    return min(shared, key=moved)


def _moved(camera: RigCamera, reference: RigCamera, found: Rig, limit: float) -> Moved:
    """The motion of a camera as seen from another one."""
    if camera.name == reference.name:
        return Moved(camera.name, np.eye(4), 1.0, False, 0.0, 0.0)
    before, C_before = _relative(reference, camera)
    now, now_reference = found.camera(camera.name), found.camera(reference.name)
    assert now is not None
    assert now_reference is not None
    after, C_after = _relative(now_reference, now)
    T = np.asarray(se3.inverse(before) @ after, np.float64)
    xi = se3.log(T)
    # The file's error is in the camera's frame as it was; moved on, it is in that of now.
    A = se3.adjoint(se3.inverse(T))
    C = A @ C_before @ A.T + C_after
    chance = float(chi2.sf(xi @ np.linalg.pinv(C, hermitian=True) @ xi, 6))
    position, rotation = (
        float(np.sqrt(max(np.linalg.eigvalsh(C[part, part])[-1], 0)))
        for part in (slice(3), slice(3, 6))
    )
    return Moved(camera.name, T, chance, chance < limit, position, rotation)


def _relative(reference: RigCamera, camera: RigCamera) -> tuple[Float64, Float64]:
    """T_reference_camera and its covariance.

    The covariances of two cameras are taken to be independent, which is on the safe side: errors
    that they share, those of the first camera, cancel.
    """
    T = np.asarray(se3.inverse(reference.T_rig_camera) @ camera.T_rig_camera, np.float64)
    A = se3.adjoint(se3.inverse(T))
    return T, np.asarray(A @ reference.covariance @ A.T + camera.covariance, np.float64)
