"""Views kept while frames stream by, on disk beyond a budget, and their comparison in pairs.

A `ViewStore` keeps evenly spaced `PosedView`s (`Spacing`); `overlaps` finds those that show the
same surfaces, by a `CoarseView` of each. `pair_equations` linearises how well a `SampledView`
fits another, over pose and calibration; `shared_error` is the error that the pixels of a patch
have in common.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.stored_views import pair_equation_kernels, pair_equations, shared_error
    from tofuse.engine.stored_views.view_store import (
        CoarseView,
        HasCoarseView,
        PosedView,
        SampledView,
        Spacing,
        Spilled,
        SpilledCoarseView,
        ViewStore,
        overlaps,
        sampled_points,
        world_centroids,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
