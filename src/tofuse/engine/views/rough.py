"""Planes with a looser tolerance, for the search with views that are too noisy for tracking."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from tofuse.engine.arrays import Float32
from tofuse.engine.views.prepared_view import PreparedView
from tofuse.engine.views.surface_options import SurfaceOptions
from tofuse.engine.views.view_planes import fitted_planes

_CHUNKS = 4
# Deviation from a plane as a fraction of the depth, and half width of a plane's window as a
# fraction of the image.
_DEVIATION, _WINDOW = 0.01, 0.016


def with_rough_planes(view: PreparedView) -> PreparedView:
    """Return the view with wide planes, fitted to median depths, where it has none.

    Tracking uses only planes that match the view's noise. A floor at grazing incidence is noisier,
    but constrains a search.
    """
    z = cv2.medianBlur(view.z, 5)
    z[(view.z <= 0) | (np.abs(z - view.z) > 5 * _DEVIATION * view.z)] = 0
    w = np.divide(1, z, out=np.zeros_like(z), where=z > 0)
    weight = np.divide(1, (_DEVIATION * w) ** 2, out=np.zeros_like(z), where=z > 0)
    options = SurfaceOptions(radii=(max(2, round(_WINDOW * z.shape[1])),), fill=0.7, offset=0.2)
    planes, quality = fitted_planes(w, view.rays, weight, weight > 0, 1.0, options, _CHUNKS)
    has_plane = view.planes[..., 3] > 0
    misfit = quality[..., 0]
    variance: Float32 = quality[..., 1] * np.where(np.isfinite(misfit), misfit, 0)
    return replace(
        view,
        planes=np.where(has_plane[..., None], view.planes, planes),
        plane_variance=np.where(has_plane, view.plane_variance, variance).astype(np.float32),
    )
