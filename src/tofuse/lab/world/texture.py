"""Appearance of a surface to an infrared camera: albedo, pattern, gloss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np

from tofuse.engine.arrays import Float64, Int32
from tofuse.lab.world import shading_kernels as kernels

Pattern = Literal["plain", "noise", "wood", "tiles", "print", "speckle"]
_KINDS: dict[Pattern, int] = {
    "plain": kernels.PLAIN,
    "noise": kernels.NOISE,
    "wood": kernels.WOOD,
    "tiles": kernels.TILES,
    "print": kernels.PRINT,
    "speckle": kernels.SPECKLE,
}

UNIFORM_ALBEDO = 0.6


@dataclass(frozen=True)
class Material:
    """One surface's near-infrared reflectance.

    Attributes
    ----------
    name
        Of the surface, for display and tests.
    albedo
        Mean diffuse reflectance, 0 to 1.
    contrast
        Approximate standard deviation of the pattern relative to the mean.
    pattern
        "plain"; "noise" (three octaves), "wood" (grain), "tiles" (joints), "print" (a poster:
        noise with strong steps), "speckle" (carpet).
    scale_m
        Size of the largest features along the three axes of the body's frame.
    gloss
        Fraction of the light that is reflected specularly, 0 to 1.
    hue
        Of its visible colour, 0 to 1; None: any that is usual for its pattern.
    """

    name: str
    albedo: float
    contrast: float = 0.0
    pattern: Pattern = "plain"
    scale_m: tuple[float, float, float] = (0.5, 0.5, 0.5)
    gloss: float = 0.0
    hue: float | None = None

    def uniform(self) -> Self:
        """Return the same surface, matte and with the common albedo of uniform surfaces."""
        return replace(self, albedo=UNIFORM_ALBEDO, contrast=0.0, pattern="plain", gloss=0.0)


def noise_tables(seed: int) -> tuple[Int32, Float64]:
    """Return (256,) tables of the noise kernels: a permutation, and values of unit variance."""
    rng = np.random.default_rng([seed, 1])
    values = np.linspace(-np.sqrt(3), np.sqrt(3), kernels.LATTICE)
    return rng.permutation(kernels.LATTICE).astype(np.int32), rng.permutation(values)


def parameter_rows(materials: Sequence[Material], seed: int) -> Float64:
    """(S, 10) parameters of the surfaces; each pattern has its own offset in the noise."""
    rows = np.zeros((len(materials), kernels.COLUMNS))
    for k, material in enumerate(materials):
        offset = np.random.default_rng([seed, 2, k]).uniform(0.0, 97.0, 3)
        rows[k, kernels.ALBEDO] = material.albedo
        rows[k, kernels.CONTRAST] = 0.0 if material.pattern == "plain" else material.contrast
        rows[k, kernels.SCALE : kernels.SCALE + 3] = material.scale_m
        rows[k, kernels.KIND] = _KINDS[material.pattern]
        rows[k, kernels.GLOSS] = material.gloss
        rows[k, kernels.OFFSET : kernels.OFFSET + 3] = offset
    return rows
