"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.views import residual_kernels
    from tofuse.engine.views.descriptor import (
        dissimilarity,
        mutual_dissimilarity,
        pairwise_dissimilarity,
        similar_views,
        view_descriptor,
    )
    from tofuse.engine.views.extended_planes import with_extended_planes
    from tofuse.engine.views.prepared_view import RAW_RANGE_FALLOFF, PreparedView, prepare_view
    from tofuse.engine.views.projection import Projection
    from tofuse.engine.views.residual_kernels import (
        ALBEDO,
        ALBEDO_SLOPE,
        BINS,
        CHI2,
        DIFFERENCE,
        DISTANCE,
        FREE_SPACE,
        HAS_PLANE,
        INLIERS,
        IS_INLIER,
        JACOBIAN,
        LANES,
        NORMAL,
        PLANE,
        POINT,
        POINT_ALBEDO,
        POINT_ALBEDO_SLOPE,
        POINT_SIZE,
        ROWS,
        SIGMA,
        SQRT_WEIGHT,
        STAT,
        VARIANCE,
        WEIGHT_G,
        WEIGHT_P,
        WEIGHTED_RESIDUAL,
        XN,
        YN,
        Residuals,
        TargetImage,
        ViewImages,
        Z,
        accumulate,
        add_products,
        bin_edge,
        compare_albedos,
        compare_planes,
        histogram_bin,
        load_block,
        normal_equations,
        project_block,
        transform_block,
        write_point,
    )
    from tofuse.engine.views.rough import with_rough_planes
    from tofuse.engine.views.surface_options import SurfaceOptions
    from tofuse.engine.views.view_planes import dilated

__getattr__, __dir__, __all__ = face(__name__, __file__)
