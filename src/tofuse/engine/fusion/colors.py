"""Colours of a model for display; black marks points without a colour in any image."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, UInt8

# Displayed colour of points without a colour.
NO_COLOR = (142, 142, 142)


def has_color(colors: UInt8) -> Bool:
    """Return which of the colours (N, 3) are known, (N,)."""
    return np.asarray(colors.any(1), np.bool_)


def display_colors(colors: UInt8) -> UInt8:
    """Return colours (N, 3) with a neutral grey for unknown ones."""
    shown = colors.copy()
    shown[~has_color(colors)] = NO_COLOR
    return shown
