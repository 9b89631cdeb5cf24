"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.cameras import depth_conversion, projection_kernels
    from tofuse.engine.cameras.cameras import (
        DISTORTION_ORDER,
        MODELS,
        BrownConrady,
        Camera,
        Fisheye,
        Pinhole,
        Rational,
        RayTable,
        lens_values,
        pinhole_values,
        ray_lengths,
        scaled,
        unknown_rays,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
