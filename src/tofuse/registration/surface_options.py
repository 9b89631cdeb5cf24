"""Options of the preparation of views, see `prepared_view.prepare_view`."""

from __future__ import annotations

from dataclasses import dataclass, replace

# Tangent of the incidence (80 degrees) up to which neighbouring pixels belong to one surface.
_STEEPEST = 5.67


@dataclass(frozen=True)
class Smoothed:
    """Preparation of views that the camera has smoothed, at a finer scale.

    In such views noise is no limit, and the structures that constrain the pose may be small.

    Attributes
    ----------
    noise
        Applies to views whose noise between neighbouring pixels is below this fraction of the
        depth.
    radii, edge_margin, fill
        Replace the fields of `SurfaceOptions`.
    """

    noise: float = 0.001
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
        Pixels within `edge_margin` pixels of a depth edge are left out of the fits, as they mix
        light of both sides. An edge is a relative difference above `edge_jump`, above that of
        neighbouring pixels on a surface at an incidence of 80 degrees, and above `edge_sigmas`
        times the view's typical noise.
    misfit
        Largest ratio of the residual variance of a window to that of the smallest windows.
    flatness
        Deviations from a plane below this fraction of the depth are accepted whatever the noise of
        the view, as cameras may smooth their images.
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
        images of kind "ir" get darker; None to estimate it from the recording. A view alone is
        taken for one in ambient light, or for that of a time-of-flight camera.
    smoothed
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
    smoothed: Smoothed = Smoothed()

    def for_pitch(self, pitch: float) -> SurfaceOptions:
        """Return the options for images with this difference of x/z between neighbouring pixels.

        In coarse images slanted surfaces have larger differences of depth, which are no edges.
        """
        jump = max(self.edge_jump, _STEEPEST * pitch)
        return self if jump == self.edge_jump else replace(self, edge_jump=jump)

    def for_noise(self, noise: float) -> SurfaceOptions:
        """Return the options for a view with this noise between neighbours, relative to depth."""
        s = self.smoothed
        if noise >= s.noise:
            return self
        return replace(self, radii=s.radii, edge_margin=s.edge_margin, fill=s.fill)
