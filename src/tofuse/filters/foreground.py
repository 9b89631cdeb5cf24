"""Keep an object in front of its background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tofuse.arrays import Bool, Float32
from tofuse.bounds import above, within
from tofuse.filters.base import Filter
from tofuse.parts import part
from tofuse.recordings.frames import Frame, RangeFrame

_BINS = 256


@part("filter", "foreground")
@dataclass(frozen=True)
class Foreground(Filter):
    """Keep points nearer than a limit that the frame itself gives, or a given one.

    For an object that turns before a background that does not: the limit is Otsu's threshold on
    the histogram of z (Otsu 1979). A frame whose depths don't fall into two classes is kept whole,
    as it shows one thing only.

    Attributes
    ----------
    limit
        Farthest z that is kept, m; None to find it in each frame.
    separability
        Share of the variance of z that lies between the two classes (Otsu's eta), 0 to 1, that is
        needed to believe in them. One evenly spread class gives 0.75, one bell curve 0.64.
    """

    limit: float | None = None
    separability: float = 0.8

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def __post_init__(self) -> None:
        if self.limit is not None:
            above("limit", self.limit, 0)
        within("separability", self.separability, 0, 1)

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        assert isinstance(frame, RangeFrame)
        if self.limit is not None:
            return frame.z <= self.limit
        limit, eta = otsu(frame.z[frame.valid])
        if not eta >= self.separability:
            return np.ones(frame.valid.shape, bool)
        return frame.z <= limit


def otsu(values: Float32) -> tuple[float, float]:
    """Find the threshold that parts values (N,) best into two classes (Otsu 1979, 256 bins).

    Returns the threshold (the lower class is at most that) and Otsu's separability eta, 0 to 1:
    the share of the variance that lies between the classes. (inf, 0) if all values are equal or
    there are none.
    """
    if len(values) == 0 or values.min() == values.max():
        return np.inf, 0.0
    counts, edges = np.histogram(values.astype(float), _BINS)
    share = counts / counts.sum()
    centre = (edges[:-1] + edges[1:]) / 2
    mean = (share * centre).sum()
    below = np.cumsum(share)[:-1]
    moment = np.cumsum(share * centre)[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        between = np.nan_to_num((mean * below - moment) ** 2 / (below * (1 - below)))
    # Between two clusters any threshold is as good; the middle one leaves most room to both.
    best = np.flatnonzero(between >= between.max() * (1 - 1e-9))
    first, last = int(best[0]), int(best[-1])
    total = (share * (centre - mean) ** 2).sum()
    return float((edges[first + 1] + edges[last + 1]) / 2), float(between.max() / total)
