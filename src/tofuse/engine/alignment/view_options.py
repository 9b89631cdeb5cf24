"""Options of the views that keyframe odometry aligns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tofuse.engine.alignment.projective import ProjectiveOptions
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.views import SurfaceOptions


@dataclass(frozen=True)
class ViewOptions(Bounded):
    """Options of preparation and alignment that depend on the camera and the scene.

    Attributes
    ----------
    columns
        Images are halved until they have at most this many columns: fewer for speed, more for fine
        structure.
    photometric
        Whether the albedo is used in the alignment; switch it off where the light changes.
    falloff
        Exponent of the cosine to the optical axis by which amplitude falls off towards the corners;
        None to estimate it from the recording.
    range_falloff
        Exponent of the range by which colour (as if lit by a lamp on the camera) or infrared
        images of kind "ir" get darker; None to estimate it from the recording.
    """

    columns: Annotated[int, Bounds(16, 4096)] = 320
    photometric: bool = True
    falloff: Annotated[float | None, Bounds(-20, 20)] = None
    range_falloff: Annotated[float | None, Bounds(0, 10)] = None

    @property
    def surface(self) -> SurfaceOptions:
        """Options of `prepare_view`."""
        return SurfaceOptions(
            columns=self.columns, falloff=self.falloff, range_falloff=self.range_falloff
        )

    @property
    def alignment(self) -> ProjectiveOptions:
        """Options of `align`."""
        return ProjectiveOptions(photometric=self.photometric)
