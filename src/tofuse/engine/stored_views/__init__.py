"""."""

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
