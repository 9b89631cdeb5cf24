"""Points of a cloud that are on no surface, such as wrong ones of a stereo matcher.

Averaging reduces surfaces to a few points, and leaves each of these as it is: a tenth of a cloud
becomes half of its averaged points, and resolutions that are chosen by these get too coarse.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.frames import CloudFrame
from tofuse.engine.geometry import KdTree
from tofuse.engine.icp import surface_shape

# Points of a sample that decides whether there are many, and of those that tell which; neighbours.
_FEW, _MANY, _NEIGHBOURS = 3000, 20_000, 12
# Isolated points have neighbours this many times as far away as is usual, and these spread across
# their plane by more than this fraction of their extent along it, as nearly all random points do.
# What a scanner saw of distant surfaces is sparse as well, but plane.
_MIN_DISTANCE, _MIN_ROUGHNESS = 3.0, 0.3
# Share of isolated points below which they do no harm.
_MAX_SHARE = 0.05


def without_isolated(view: CloudFrame) -> CloudFrame:
    """Return a cloud without isolated points; itself if it has few."""
    if len(view) <= _NEIGHBOURS or _examined(view, _FEW)[1].mean() < _MAX_SHARE:
        return view
    cleaned = _reduced(view, _MAX_SHARE)
    # Without the first ones, others stand out more.
    return view if cleaned is view else _reduced(cleaned, 0.0)


def _reduced(view: CloudFrame, min_share: float) -> CloudFrame:
    """Return a cloud without points that stand out; itself if these are a smaller share."""
    points, isolated, reach = _examined(view, _MANY)
    if isolated.mean() < min_share:
        return view
    nearest, distance = KdTree(points[~isolated]).nearest(view.points)
    return view.keep(distance <= reach[~isolated][nearest])


def sampled(view: CloudFrame, count: int) -> CloudFrame:
    """Return a random subset of the points, in their order; the view itself if it has no more."""
    if len(view) <= count:
        return view
    kept = np.zeros(len(view), bool)
    kept[np.random.default_rng(0).choice(len(view), count, replace=False)] = True
    return view.keep(kept)


def _examined(view: CloudFrame, count: int) -> tuple[Float64, Bool, Float64]:
    """Return a sample (n, 3), which of it is isolated, and squares of how far neighbours reach."""
    sample = sampled(view, count)
    shape = surface_shape.shape_at(sample, np.arange(len(sample)), _NEIGHBOURS)
    reach = surface_shape.tree_of(sample).neighbours(sample.points, _NEIGHBOURS)[1][:, -1]
    usual = np.median(reach[reach > 0]) if reach.any() else 0.0  # points may repeat
    is_far = reach > _MIN_DISTANCE**2 * usual
    return sample.points.astype(np.float64), is_far & (shape.roughness > _MIN_ROUGHNESS), reach
