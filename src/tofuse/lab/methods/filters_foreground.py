"""Filter of the background behind an object, by a threshold of z."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from tofuse.engine.arrays import Bool, Float32
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.filters import Filter
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part

_BINS = 256


@part("filter", "foreground")
@dataclass(frozen=True)
class Foreground(Bounded, Filter):
    """Keep points nearer than a limit, by default Otsu's threshold on the histogram of z.

    For an object that turns in front of a static background (Otsu 1979). Frames whose depths don't
    separate into two classes are unchanged.

    Attributes
    ----------
    limit
        Largest z that is kept, m; None to estimate it in each frame.
    separability
        Smallest fraction of the variance of z that lies between the two classes (Otsu's eta, 0 to
        1). A uniform distribution has 0.75, a normal distribution 0.64.
    """

    limit: Annotated[float | None, Bounds(0, exclusive=True)] = None
    separability: Annotated[float, Bounds(0, 1)] = 0.8

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

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
    """Return the threshold that best separates values (N,) into two classes (Otsu 1979, 256 bins).

    Returns the threshold (inclusive for the lower class) and Otsu's separability eta, 0 to 1: the
    fraction of the variance that lies between the classes. (inf, 0) if all values are equal or
    there are none.
    """
    if len(values) == 0 or values.min() == values.max():
        return np.inf, 0.0
    counts, edges = np.histogram(values.astype(float), _BINS)
    fraction = counts / counts.sum()
    centre = (edges[:-1] + edges[1:]) / 2
    mean = (fraction * centre).sum()
    below = np.cumsum(fraction)[:-1]
    moment = np.cumsum(fraction * centre)[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        between = np.nan_to_num((mean * below - moment) ** 2 / (below * (1 - below)))
    # Between two clusters all thresholds are equivalent; the central one has the largest margin.
    best = np.flatnonzero(between >= between.max() * (1 - 1e-9))
    first, last = int(best[0]), int(best[-1])
    total = (fraction * (centre - mean) ** 2).sum()
    return float((edges[first + 1] + edges[last + 1]) / 2), float(between.max() / total)
