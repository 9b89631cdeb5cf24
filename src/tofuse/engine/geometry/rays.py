"""Unit vectors; and points along rays, which cameras give as (x/z, y/z)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.arrays import Float64


def homogeneous(rays: ArrayLike) -> Float64:
    """Return the points (..., 3) at z = 1 of rays (..., 2)."""
    rays = np.asarray(rays, float)
    return np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], -1)


def unit_rays(rays: ArrayLike) -> Float64:
    """Return the unit vectors (..., 3) of rays (..., 2)."""
    return unit_vectors(homogeneous(rays))


def unit_vectors(vectors: ArrayLike) -> Float64:
    """Return vectors (..., n) of length 1, zeros of zeros."""
    vectors = np.asarray(vectors, float)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


def sphere_directions(count: int) -> Float64:
    """Return unit vectors (count, 3), evenly over the sphere: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z, azimuth = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1)


def tangents(normals: ArrayLike) -> Float64:
    """Return two unit vectors (..., 2, 3) perpendicular to each normal (..., 3) and each other."""
    normals = np.asarray(normals, float)
    axis = np.eye(3)[np.argmin(np.abs(np.nan_to_num(normals)), axis=-1)]
    first = unit_vectors(np.cross(axis, normals))
    return np.stack([first, np.cross(normals, first)], -2)
