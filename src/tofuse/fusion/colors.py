"""Colours of a model for who looks at it: where no image showed one, they are black."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Bool, UInt8

# Where no image showed a colour.
UNSEEN = (142, 142, 142)


def has_color(colors: UInt8) -> Bool:
    """Say which colours (N, 3) an image showed."""
    return np.asarray(colors.any(1), np.bool_)


def seen_colors(colors: UInt8) -> UInt8:
    """Return colours (N, 3) with a neutral grey where no image showed one."""
    out = colors.copy()
    out[~has_color(colors)] = UNSEEN
    return out
