"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
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
        points_from_z,
        range_from_z,
        ray_lengths,
        scaled,
        unknown_rays,
        z_from_range,
    )
    from tofuse.engine.cameras.projection_kernels import (
        MIN_DEPTH,
        in_image,
        jacobian_row,
        nearest_pixel,
        project_ray,
        project_rays,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
