"""A check of closed loops: neighbouring views must still agree."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.search import pair_agreement
from tofuse.engine.stored_views import PosedView
from tofuse.engine.views import PreparedView


def degraded_neighbours(
    views: Sequence[PosedView[PreparedView]],
    before: Float64,
    after: Float64,
    suspects: frozenset[int],
) -> Iterator[tuple[int, int]]:
    """Yield the frame indices i, j of neighbouring views that agree less after loops were closed.

    Least squares puts the gap of a loop where registrations are least certain. If the images there
    fit the poses before better, the registration was right, and the error is elsewhere.

    Parameters
    ----------
    views
        N views, ascending.
    before, after
        (N, 4, 4) poses before and after.
    suspects
        Indices of the frames with uncertain registrations: only neighbours i, j with one of them
        in (i, j] are compared.
    """
    relative = [se3.inverse(poses[:-1]) @ poses[1:] for poses in (before, after)]
    for a, b, T, T_closed in zip(views[:-1], views[1:], *relative, strict=True):
        if suspects.isdisjoint(range(a.index + 1, b.index + 1)):
            continue
        compared = pair_agreement.Comparison.of(b.view, a.view)
        if compared.at(T_closed).score < compared.at(T).score - pair_agreement.MIN_LEAD:
            yield a.index, b.index
