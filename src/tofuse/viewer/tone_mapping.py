"""Inverse of the tone mapping in viser's page.

The page shows surfaces through the filmic curve of ACES (S. Hill's fit, as in three.js), which
desaturates and darkens: colours of values would differ from the colour bar. Points are unaffected.
"""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float32, UInt8
from tofuse.files.glb import linear_of_srgb

_INPUT_MATRIX = np.array(
    [[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]]
)
_OUTPUT_MATRIX = np.array(
    [[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]]
)
_EXPOSURE = 0.6
_MAX_OUTPUT = 0.995  # the curve hardly exceeds it


def inverse_tone_mapping(color: UInt8) -> Float32:
    """Return linear RGB (N, 3) that the page shows as the given sRGB colours (N, 3).

    Components can be negative for saturated colours, and above 1 for bright ones.
    """
    y = np.clip(linear_of_srgb()[color] @ np.linalg.inv(_OUTPUT_MATRIX).T, 0, _MAX_OUTPUT)
    # y = (v^2 + 0.0245786 v - 0.000090537) / (0.983729 v^2 + 0.432951 v + 0.238081)
    a, b, c = 1 - 0.983729 * y, 0.0245786 - 0.432951 * y, -0.000090537 - 0.238081 * y
    v = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a)
    light_in: Float32 = (_EXPOSURE * v @ np.linalg.inv(_INPUT_MATRIX).T).astype(np.float32)
    return light_in
