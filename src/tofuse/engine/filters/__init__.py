"""Which points of a view are to be believed: filters mark the others as invalid.

Each is a `Filter` with a name in configurations, and `apply_filters` applies a list of them. Most
look at one pixel or its neighbours (`Confidence`, `NeighbourhoodAngle`); `moving_object` separates
an object from the static background over many frames.
"""

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
    from tofuse.engine.filters.thresholds import Confidence

__getattr__, __dir__, __all__ = face(__name__, __file__)
