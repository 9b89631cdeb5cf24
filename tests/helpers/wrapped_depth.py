"""A recording whose range wraps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np


def wrapping(frames, period):
    """Frame of a camera with this ambiguity range and range-compensated amplitude."""
    out = []
    for f in frames:
        radial = np.maximum(f.radial_range, np.float32(1e-6))
        near = np.mod(f.radial_range, period) / radial
        light = f.amplitude_image
        if f.amplitude_kind == "range_compensated":
            light = light * near**2
        out.append(replace(f, depth=f.depth * near, amplitude_image=light, ambiguity_m=period))
    return out
