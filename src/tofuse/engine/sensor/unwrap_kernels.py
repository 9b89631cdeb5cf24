"""Loopy belief propagation of the number of periods between neighbouring pixels."""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, Float32
from tofuse.engine.compute import kernel

# Offsets of a pixel's neighbours, (row, column); opposite directions are two places apart.
NEIGHBOURS = ((0, 1), (1, 0), (0, -1), (-1, 0))


@kernel
def pass_messages(
    range_m: Float32,
    valid: Bool,
    unary: Float32,
    period: float,
    scale: float,
    truncation: float,
    start: int,
    stop: int,
    parity: int,
    messages: Float32,
) -> None:
    """Update the messages that pixels of one colour of a checkerboard send to their neighbours.

    Min-sum algorithm (Felzenszwalb and Huttenlocher 2006; half of the pixels at a time, section
    3.2).

    Parameters
    ----------
    range_m (H, W), valid (H, W)
        Wrapped range in [0, period).
    unary (H, W, K)
        Cost of each number of periods.
    period, scale, truncation
        Neighbours with unwrapped ranges a and b cost min(|a - b| / scale, truncation).
    start, stop, parity
        Rows whose pixels (i + j) % 2 == parity send.
    messages (4, H, W, K)
        Messages received by each pixel from each side, in the order of `NEIGHBOURS`; updated.
    """
    height, width, labels = unary.shape
    belief = np.empty(labels)
    sent = np.empty(labels)
    for i in range(start, stop):
        for j in range(width):
            if not valid[i, j] or (i + j) % 2 != parity:
                continue
            for s in range(4):
                v, u = i + NEIGHBOURS[s][0], j + NEIGHBOURS[s][1]
                if v < 0 or u < 0 or v >= height or u >= width or not valid[v, u]:
                    continue
                for k in range(labels):
                    total = unary[i, j, k]
                    for t in range(4):
                        # The message received from that neighbour is not sent back.
                        if t != s:
                            total += messages[t, i, j, k]
                    belief[k] = total
                difference = range_m[v, u] - range_m[i, j]
                lowest = np.inf
                for m in range(labels):
                    best = np.inf
                    for k in range(labels):
                        jump = abs(difference + (m - k) * period) / scale
                        best = min(best, belief[k] + min(jump, truncation))
                    sent[m] = best
                    lowest = min(lowest, best)
                opposite = (s + 2) % 4
                for m in range(labels):
                    messages[opposite, v, u, m] = sent[m] - lowest
