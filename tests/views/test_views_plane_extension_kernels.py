"""Planes extended to adjacent pixels, against a slow NumPy reference."""

from __future__ import annotations

import itertools

import numpy as np

from tofuse.engine.views.view_planes_kernels import extend_planes

STEPS = np.array([(0, 1), (1, 0), (0, -1), (-1, 0), (2, -1), (-2, 2)], np.int32)
GROWTH = np.array([1.5, 1.5, 1.5, 1.5, 3.5, 5.0], np.float32)
SIGMAS, JUMP = 3.0, 0.04


def extension_twin(w, sigma, rays, wanted, planes, variance, jump=JUMP):
    found, varied = planes.astype(float), variance.astype(float)
    for i, j in itertools.product(*map(range, w.shape)):
        for (di, dj), growth in zip(STEPS.tolist(), GROWTH, strict=True):
            p, q = i + di, j + dj
            inside = 0 <= p < w.shape[0] and 0 <= q < w.shape[1]
            if not wanted[i, j] or not inside or planes[p, q, 3] == 0:
                continue
            value = planes[p, q, :3].astype(float) @ [*rays[i, j], 1]
            near = abs(value - planes[p, q, 3]) <= jump * value
            grown = growth * variance[p, q]
            quiet = sigma[i, j] <= 2 * sigma[p, q]
            if (
                quiet
                and near
                and abs(w[i, j] - value) <= SIGMAS * np.sqrt(sigma[i, j] ** 2 + grown)
            ):
                found[i, j], varied[i, j] = [*planes[p, q, :3], value], grown
                break
    return found, varied


def test_extended_planes_match_slow_twin():
    rng = np.random.default_rng(1)
    shape = (15, 17)
    rays = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 17), np.linspace(-0.3, 0.3, 15)), -1)
    rays = rays.astype(np.float32)
    # Two surfaces, the right one partly hidden; pixels of both, and between.
    abc = np.where(np.arange(17)[None, :, None] < 8, [0.1, -0.2, 0.5], [1.1, 0.1, 0.53])
    abc = np.broadcast_to(abc, (*shape, 3))
    w = (abc[..., 0] * rays[..., 0] + abc[..., 1] * rays[..., 1] + abc[..., 2]).astype(np.float32)
    planes = np.concatenate([abc, w[..., None]], -1).astype(np.float32)
    planes[rng.random(shape) < 0.5] = 0
    variance = rng.uniform(1e-6, 4e-5, shape).astype(np.float32)
    sigma = rng.uniform(0.001, 0.01, shape).astype(np.float32)
    w = (w + 1.5 * sigma * rng.normal(size=shape)).astype(np.float32)
    wanted = (planes[..., 3] == 0) & (rng.random(shape) < 0.9)
    found, varied = planes.copy(), variance.copy()
    extend_planes(
        w, sigma, rays, wanted, planes, variance, STEPS, GROWTH, SIGMAS, JUMP, found, varied
    )
    twin, twin_varied = extension_twin(w, sigma, rays, wanted, planes, variance)
    new = twin[..., 3] != planes[..., 3]
    # Some pixels get a neighbour's plane, others none: the right surface is too steep along rows.
    assert 40 < new.sum() < wanted.sum() - 10
    assert not new[~wanted].any()
    steep = extension_twin(w, sigma, rays, wanted, planes, variance, jump=1.0)[0][..., 3]
    assert (steep != twin[..., 3]).sum() > 5
    np.testing.assert_allclose(found, twin, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(varied, twin_varied, rtol=1e-5)
