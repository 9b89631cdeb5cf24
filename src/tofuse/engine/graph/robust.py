"""Robust kernels: bounded influence of edges with errors beyond their information.

A kernel is a function of an edge's squared error ``x = e^T Omega e`` and a threshold c: its cost
rho(x), which replaces x in the objective, and its weight w(x) = rho'(x), a factor on the edge's
information in the next step (iteratively reweighted least squares).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tofuse.engine.arrays import Float64

MEDIAN = 5.3481  # of a chi-square variable with six degrees of freedom

Robust = Literal["none", "huber", "cauchy", "geman-mcclure", "dcs", "switchable", "truncated"]


@dataclass(frozen=True)
class Settings:
    """Options of the minimisation.

    Attributes
    ----------
    robust
        Kernel of the loop edges.
    gate
        Threshold on an edge's squared error in units of its information: at 100, ten standard
        deviations. (That of an ideal edge is chi-square with six degrees of freedom, above 40 only
        once in two million; few edges are ideal.)
    max_inflation
        Largest factor on the loops' standard deviations, as stated information is often too large;
        estimated from the quartile of the loops' errors. Only for "truncated".
    tolerance
        Iterations stop when a step lowers the objective by a smaller fraction.
    max_iterations
        Maximum number of steps, in each of the stages of "truncated".
    best_start
        Whether to begin with chordal initialisation where it has a lower objective than the given
        poses. "truncated" does so if it has to select.
    """

    robust: Robust = "truncated"
    gate: float = 100.0
    max_inflation: float = 3.0
    tolerance: float = 1e-6
    max_iterations: int = 100
    best_start: bool = False


def cost(kernel: Robust, x: Float64, c: float) -> Float64:
    """Return rho(x) of squared errors x and a threshold c on x.

    "huber", "cauchy", "geman-mcclure" (Zhang 1997); "dcs", dynamic covariance scaling (Agarwal et
    al. 2013); "switchable", switchable constraints (Suenderhauf and Protzel 2012) with a linear
    switch, whose optimum s = c / (c + x) costs ``s^2 x + c (1 - s)^2``, the cost of Geman and
    McClure; "truncated": truncated least squares.
    """
    if kernel == "huber":
        return np.where(x <= c, x, 2 * np.sqrt(c * np.maximum(x, c)) - c)
    if kernel == "cauchy":
        return c * np.log1p(x / c)
    if kernel in ("geman-mcclure", "switchable"):
        return c * x / (c + x)
    if kernel == "dcs":
        return np.where(x <= c, x, c * (3 * x - c) / (x + c))
    if kernel == "truncated":
        return np.minimum(x, c)
    return x


def weight(kernel: Robust, x: Float64, c: float) -> Float64:
    """Return w(x) = rho'(x), 0 to 1."""
    if kernel == "huber":
        return np.sqrt(c / np.maximum(x, c))
    if kernel == "cauchy":
        return c / (c + x)
    if kernel in ("geman-mcclure", "switchable"):
        return (c / (c + x)) ** 2
    if kernel == "dcs":
        return np.minimum(1.0, 2 * c / (c + x)) ** 2
    if kernel == "truncated":
        return (x <= c).astype(float)
    return np.ones_like(x)
