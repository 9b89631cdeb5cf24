"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.filters.background import (
        BackgroundSurface,
        background_surface,
        moving_object,
    )
    from tofuse.engine.filters.base import Filter, Interval, Removal, apply_filters
    from tofuse.engine.filters.outliers import (
        MAX_NEIGHBOURS,
        NeighbourFraction,
        NeighbourhoodAngle,
        mean_neighbour_distance,
    )
    from tofuse.engine.filters.thresholds import Confidence, Foreground

__getattr__, __dir__, __all__ = face(__name__, __file__)
