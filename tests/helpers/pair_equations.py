"""Normal equations of one pair of views, by the kernel for all pairs of a target."""

from __future__ import annotations

import numpy as np

from tofuse.engine.stored_views import pair_equation_kernels as kernels

KNOWN = np.ones(kernels.ERRORS, np.int64)


def pair_equations(
    points, surface, T, residuals, errors=None, known=KNOWN, patches=None, count=0, scale=1.0
):
    """Equations (SIZE,) of source points and a target surface, and their sums over patches."""
    row, sums = np.empty((1, kernels.SIZE)), np.empty((1, count, kernels.PATCH_SIZE))
    scales = (np.array([scale]) for scale in residuals[:3])
    kernels.target_equations(
        kernels.SourcePoints(
            points,
            np.zeros(len(points), np.int64) if patches is None else patches,
            np.array([0]),
            np.array([len(points)]),
            np.array([surface.measures_range]),
            surface.projection.lens,
        ),
        np.array([0]),
        *targets([surface], [0, 1], scale),
        np.ascontiguousarray(T)[None],
        kernels.PairResiduals(*scales, *residuals[3:]),
        np.zeros(kernels.ERRORS) if errors is None else errors,
        known,
        row,
        sums,
    )
    return row[0], sums[0]


def targets(surfaces, ends, scale=1.0):
    """Images and targets of the kernel: the pairs of surface k are from ends[k] to ends[k + 1]."""
    images = [surface.target_image for surface in surfaces]
    images += images[-1:] * (kernels.TARGETS - len(images))
    return tuple(images), kernels.TargetViews(
        np.array([surface.measures_range for surface in surfaces]),
        np.full(len(surfaces), scale),
        np.array(ends),
    )
