"""Camera models: the ray of each pixel, and the pixel of each ray.

A `Camera` is anything with `rays()` and `project()`; `MODELS` are the lenses that `camera.json`
names, and a `RayTable` is any other. `depth_conversion` turns radial range into depth and points;
`projection_kernels` project into a view inside kernels; `lens` is the distortion of any camera.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.cameras import depth_conversion, lens, projection_kernels
    from tofuse.engine.cameras.cameras import (
        DISTORTION_ORDER,
        MODELS,
        BrownConrady,
        Camera,
        Fisheye,
        Pinhole,
        Rational,
        RayTable,
        pinhole_values,
        ray_lengths,
        scaled,
        unknown_rays,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
