"""Options of the preparation of views, see `prepared_view.prepare_view`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

# Tangent of the incidence (80 degrees) up to which neighbouring pixels belong to one surface.
_STEEPEST = 5.67
# Above this difference of x/z between neighbouring pixels, windows shrink: one of the same number
# of pixels would rarely cover a single surface.
_COARSE = 0.01


@dataclass(frozen=True)
class FineScale:
    """Preparation of views with little noise, or smoothed by the camera, at a finer scale.

    In such views noise is no limit, and the structures that constrain the pose may be small.

    Attributes
    ----------
    noise
        Applies to views whose noise between neighbouring pixels, relative to the depth, is below
        this fraction of the difference of their x/z: then few pixels determine a slope.
    radii, edge_margin, fill
        Replace the fields of `SurfaceOptions`.
    """

    noise: float = 0.3
    radii: tuple[int, ...] = (1, 2)
    edge_margin: int = 0
    fill: float = 0.5


@dataclass(frozen=True)
class SurfaceOptions:
    """Options of the preparation of a view.

    Attributes
    ----------
    columns
        Images are halved until they have at most this many columns (further if they are sparse).
    radii
        Half widths of the windows of the plane fits, pixels: the smallest gives the depth, the
        widest one that contains a single surface gives the slope.
    edge_jump, edge_margin, edge_sigmas
        Pixels within `edge_margin` pixels of a depth edge are excluded from the fits, as they mix
        light of both sides. An edge is a relative difference above `edge_jump`, above that of
        neighbouring pixels on a surface at an incidence of 80 degrees, and above `edge_sigmas`
        times the view's typical noise.
    misfit
        Largest ratio of the residual variance of a window to that of the smallest windows.
    flatness
        Deviations from a plane below this fraction of the depth are accepted regardless of the
        noise of the view, as cameras may smooth their images.
    fill, offset
        Smallest valid fraction of a window, and largest squared offset of its valid pixels'
        centroid relative to their variance.
    albedo_radius
        Half width of the box filter of the albedo, pixels.
    falloff
        Exponent of the cosine to the optical axis by which amplitude falls off towards the corners;
        None to estimate it from the recording.
    range_falloff
        Exponent of the range by which colour (as if lit by a lamp on the camera) or infrared
        images of kind "ir" get darker; None to estimate it from the recording. A single view is
        assumed to be in ambient light, or of a time-of-flight camera.
    fine_scale
        Options for views with hardly any noise.
    """

    columns: int = 320
    radii: tuple[int, ...] = (2, 5)
    edge_jump: float = 0.04
    edge_margin: int = 1
    edge_sigmas: float = 3.0
    misfit: float = 1.2
    flatness: float = 0.002
    fill: float = 0.7
    offset: float = 0.2
    albedo_radius: int = 1
    falloff: float | None = None
    range_falloff: float | None = None
    fine_scale: FineScale = FineScale()

    def for_image(self, pitch: float, noise: float = math.inf) -> SurfaceOptions:
        """Return the options for an image with this resolution and noise.

        In coarse images slanted surfaces have larger differences of depth, which are no edges, and
        a window of the same number of pixels spans more surfaces.

        Parameters
        ----------
        pitch
            Difference of x/z between neighbouring pixels.
        noise
            Between neighbouring pixels, relative to the depth.
        """
        fine, options = self.fine_scale, self
        if noise < fine.noise * pitch:
            options = replace(self, radii=fine.radii, edge_margin=fine.edge_margin, fill=fine.fill)
        scale = min(1.0, _COARSE / pitch)
        return replace(
            options,
            edge_jump=max(options.edge_jump, _STEEPEST * pitch),
            radii=tuple(max(k, round(scale * r)) for k, r in enumerate(options.radii, start=1)),
        )
