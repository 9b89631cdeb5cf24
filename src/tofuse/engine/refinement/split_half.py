"""Errors of refined poses, from halves of the images that are refined separately.

The covariance of the poses assumes that errors are independent between pairs of views, and that
those within a view have a given correlation length. Errors that depend on the position in the image
(lens, multipath, smoothing by the camera), or that consecutive views share, are neither, and hardly
leave residuals. But they differ between the left and the right half of the image, or between the
upper and the lower half, so poses refined with one half differ from those refined with the other.

With a and b the displacements of the poses when they are refined with either half alone, the mean
of -a b is the variance of the poses. For halves with the same information this is the square of
half their difference. If one half hardly constrains a direction, its poses move and those of the
other half do not, and the product is small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.compute import run_all
from tofuse.engine.geometry import se3
from tofuse.engine.refinement.joint_alignment import RefinedViews, align_views
from tofuse.engine.stored_views import pair_equations, shared_error

# The poses are near the solution of each half.
_ROUNDS = (pair_equations.Round(4, 0.0, 0.0),)
# Every n-th point of a half is enough for the errors that they share.
_POINT_STRIDE = 2


def split_half_errors(aligned: RefinedViews) -> tuple[float, float]:
    """Rms errors (m, rad) of refined poses, after alignment, from halves of the images."""
    variances = np.zeros(2)
    for poses in refined_by_halves(aligned):
        first, second = (aligned_motion(aligned.refined.poses, half_poses) for half_poses in poses)
        product = [-(a * b).sum(1).mean() for a, b in zip(first, second, strict=True)]
        variances += np.maximum(product, 0.0)
    position, rotation = np.sqrt(variances).tolist()
    return position, rotation


def refined_by_halves(aligned: RefinedViews) -> list[tuple[Float64, Float64]]:
    """Return the poses (N, 4, 4) by left and right halves of all images, and by upper and lower."""
    views, refined = aligned.views, aligned.refined
    single_round = replace(aligned.options, rounds=_ROUNDS)

    def by_half(first_half: bool, halves: Sequence[Bool]) -> Float64:
        half_views = [
            v.with_points(np.flatnonzero(half == first_half)[::_POINT_STRIDE])
            for v, half in zip(views, halves, strict=True)
        ]
        return align_views(
            half_views,
            refined.poses,
            single_round,
            calibrate=aligned.calibrate,
            errors=refined.errors,
            priors=aligned.priors,
            pairs=refined.pairs,
            scales=refined.scales,
        ).poses

    left = [v.patches % shared_error.ACROSS < shared_error.ACROSS // 2 for v in views]
    upper = [v.patches // shared_error.ACROSS < shared_error.DOWN // 2 for v in views]
    # In parallel, as solving for the poses is serial.
    by_left, by_right, by_upper, by_lower = run_all(
        [partial(by_half, first, halves) for halves in (left, upper) for first in (True, False)]
    )
    return [(by_left, by_right), (by_upper, by_lower)]


def aligned_motion(before: Float64, after: Float64) -> tuple[Float64, Float64]:
    """Return small motions of positions and of rotations (N, 3), less one of all poses together.

    Parameters
    ----------
    before, after
        (N, 4, 4) T_world_camera; motions are in the world, m and rad.
    """
    p = before[:, :3, 3]
    translation = after[:, :3, 3] - p
    rotation = np.einsum(
        "nij,nj->ni", before[:, :3, :3], se3.log(se3.inverse(before) @ after)[:, 3:]
    )
    motion = np.concatenate([np.tile(np.eye(3), (len(p), 1, 1)), -se3.hat(p - p.mean(0))], 2)
    motion = motion.reshape(-1, 6)
    translation = translation - (motion @ (np.linalg.pinv(motion) @ translation.ravel())).reshape(
        -1, 3
    )
    return translation, rotation - rotation.mean(0)


def rms_motion(before: Float64, after: Float64) -> tuple[float, float]:
    """Return the rms of `aligned_motion`, m and rad."""
    m, rad = (float(np.sqrt((v**2).sum(1).mean())) for v in aligned_motion(before, after))
    return m, rad
