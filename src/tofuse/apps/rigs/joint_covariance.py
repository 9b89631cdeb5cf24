"""Parts of the covariance of a rig's joint estimate, see `joint`."""

from __future__ import annotations

import numpy as np

from tofuse.engine.alignment import bounded_below
from tofuse.engine.arrays import Float64

# Size of regions of space with equal errors, as a fraction of the depth.
_REGION = 0.1
# Largest sigma of a constrained direction, and the sigma of an unconstrained one, in units of 1 cm
# and 1 degree.
_MAX_SIGMA, _UNCONSTRAINED_SIGMA = 3.0, 30.0


def by_region(positions: Float64, rows: Float64) -> tuple[Float64, Float64]:
    """Sum rows (N, n) over regions of space.

    Parameters
    ----------
    positions
        (N, 3) positions, as fractions of the depth.

    Returns
    -------
    The regions (R, 3), integers, and their sums (R, n).
    """
    cells = np.floor(positions / _REGION)
    regions, inverse = np.unique(cells, axis=0, return_inverse=True)
    out = np.zeros((len(regions), rows.shape[1]))
    np.add.at(out, inverse.ravel(), rows)
    return regions, out


def correlated(places: Float64, gradients: Float64, reach: float) -> Float64:
    """Return the covariance (n, n) of the gradient due to residuals that are correlated in space.

    Parameters
    ----------
    places, gradients
        (R, 3) regions of space, repeated for each pair, and (R, n) sums of the gradient in them.
    reach
        Correlation length (to 1/e), as a fraction of the depth.
    """
    regions, inverse = np.unique(places, axis=0, return_inverse=True)
    g = np.zeros((len(regions), gradients.shape[1]))
    np.add.at(g, inverse.ravel(), gradients)
    at = (regions + 0.5) * _REGION
    distance = np.linalg.norm(at[:, None] - at[None], axis=2)
    return np.asarray(g.T @ np.exp(-distance / reach) @ g, np.float64)


def inverse_slope(plain: Float64, cross: Float64, steepness: float) -> tuple[Float64, Float64]:
    """Return the inverse of the gradient's derivative, and the covariance where that vanishes.

    Directions beyond the largest sigma are unconstrained: their information is noise of normals.

    Parameters
    ----------
    plain, cross
        (n, n) Hessians without and with robust weights, in units of 1 cm and 1 degree.
    steepness
        As in `registration.uncertainty`.
    """
    plain, cross = 0.5 * (plain + plain.T), 0.5 * (cross + cross.T)
    X = bounded_below(cross, plain, steepness, _MAX_SIGMA**-2)
    values, vectors = np.linalg.eigh(plain)
    weak, strong = vectors[:, values < _MAX_SIGMA**-2], vectors[:, values >= _MAX_SIGMA**-2]
    inverse = strong @ np.linalg.inv(strong.T @ X @ strong) @ strong.T
    return inverse, _UNCONSTRAINED_SIGMA**2 * weak @ weak.T
