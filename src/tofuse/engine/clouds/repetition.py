"""Translations at which two clouds coincide as well as at a pose: those of repeated structure.

The columns of a hall, or the desks of a classroom, are all alike: their features are hardly ever
matched by one and the same shift. The correlation of both clouds shows these shifts.
"""

from __future__ import annotations

import numpy as np
import scipy  # loads its parts when they are used

from tofuse.engine.arrays import Float64
from tofuse.engine.clouds.cloud_agreement import CloudMap
from tofuse.engine.geometry import se3

# Edge of the cells in resolutions, and most cells along an axis.
_CELL, _MAX_CELLS = 2.0, 100
# Number of shifts, and least of their correlations, relative to that at the pose.
_MAX_SHIFTS, _MIN_CORRELATION = 3, 0.5


def shifts(
    source: CloudMap, target: CloudMap, T_target_source: Float64, distinct_m: float
) -> Float64:
    """Return translations (k, 3) in the target's frame, m, at which distinct surfaces coincide.

    Each point counts by its share in its plane, so that floors and walls hardly count.

    Parameters
    ----------
    source, target
        The clouds.
    T_target_source
        (4, 4) pose that the translations follow.
    distinct_m
        Distance between them, and from none, in m.
    """
    clouds = se3.transform(T_target_source, source.compared[0]), target.compared[0]
    if not min(map(len, clouds)):
        return np.zeros((0, 3))
    joined = np.concatenate(clouds)
    low = joined.min(0)
    extent = joined.max(0) - low
    cell = max(_CELL * target.size, float(extent.max()) / _MAX_CELLS)
    shape = tuple(2 * (int(cells) + 1) for cells in extent / cell)  # so that no shift wraps round
    spectra = []
    for points, share in zip(clouds, (source.surface_share, target.surface_share), strict=True):
        grid = np.zeros(shape, np.float32)
        np.add.at(grid, tuple(((points - low) / cell).astype(np.intp).T), share)
        spectra.append(scipy.fft.rfftn(grid))
    product = np.conj(spectra[0]) * spectra[1]
    correlation = scipy.fft.fftshift(scipy.fft.irfftn(product, shape))
    origin = np.array(shape) // 2
    reach = int(distinct_m / cell) + 1
    peak, found = origin, []
    least = _MIN_CORRELATION * correlation[tuple(origin)]
    for _ in range(_MAX_SHIFTS):
        correlation[tuple(slice(max(k - reach, 0), k + reach + 1) for k in peak)] = 0
        peak = np.array(np.unravel_index(correlation.argmax(), shape))
        if not correlation[tuple(peak)] > least:
            break
        found.append(cell * (peak - origin))
    return np.array(found).reshape(-1, 3)
