"""Rough surfaces where a view is too noisy for the tracker's: enough to find the way by."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from tofuse.arrays import Float32
from tofuse.kernels.surface import fit_planes
from tofuse.kernels.threads import run_chunks
from tofuse.registration.prepared_view import PreparedView

_CHUNKS = 4
# Share of the depth by which a surface may be off its plane, and half width of a plane as a share
# of the image.
_ROUGH, _WINDOW = 0.01, 0.016


def with_rough_planes(view: PreparedView) -> PreparedView:
    """Return the view with wide planes, of median depths, where it has none of its own.

    The tracker wants planes that are as good as the noise of the view says. A grazed floor is
    noisier than that, and yet it tells a search where the camera stands.
    """
    z = cv2.medianBlur(view.z, 5)
    z[(view.z <= 0) | (np.abs(z - view.z) > 5 * _ROUGH * view.z)] = 0
    w = np.divide(1, z, out=np.zeros_like(z), where=z > 0)
    weight = np.divide(1, (_ROUGH * w) ** 2, out=np.zeros_like(z), where=z > 0)
    known = weight > 0
    rows, columns = z.shape
    planes = np.empty((rows, columns, 4), np.float32)
    quality = np.empty((rows, columns, 2), np.float32)
    radii = np.array([max(2, round(_WINDOW * columns))], np.int64)
    run_chunks(
        lambda a, b: fit_planes(
            w, view.rays, weight, known, radii, 1.0, 0.7, 0.2, planes, quality, a, b
        ),
        rows,
        _CHUNKS,
    )
    own = view.planes[..., 3] > 0
    misfit = quality[..., 0]
    spread: Float32 = quality[..., 1] * np.where(np.isfinite(misfit), misfit, 0)
    return replace(
        view,
        planes=np.where(own[..., None], view.planes, planes),
        plane_variance=np.where(own, view.plane_variance, spread).astype(np.float32),
    )
