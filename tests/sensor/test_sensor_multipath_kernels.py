"""The kernels of multipath compensation against slow NumPy references."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.sensor import multipath_kernels as kernels
from tofuse.engine.sensor.multipath_kernels import AMPLITUDE, AREA, COLUMNS, A, B, C, W, X, Y


def grid_rays(height: int, width: int, pitch: float = 0.01) -> np.ndarray:
    x, y = np.meshgrid(
        (np.arange(width) - width / 2) * pitch, (np.arange(height) - height / 2) * pitch
    )
    return np.stack([x, y], -1).astype(np.float32)


def means(z: np.ndarray, rays: np.ndarray, light: np.ndarray, step: int) -> np.ndarray:
    nodes = np.empty((-(-z.shape[0] // step), -(-z.shape[1] // step), COLUMNS))
    kernels.block_means(
        z.astype(np.float32), rays, np.asarray(light, np.float32), step, 0.03, nodes
    )
    return nodes


def fitted(nodes: np.ndarray, limit: float = 0.006) -> np.ndarray:
    planes = np.zeros((*nodes.shape[:2], 4))
    seen = nodes[..., W] > 0
    length = np.sqrt(1 + nodes[..., X] ** 2 + nodes[..., Y] ** 2)
    measured = np.where(seen, length / np.where(seen, nodes[..., W], 1), 0)
    for radius in (2, 1):
        kernels.window_planes(nodes, radius, planes)
        kernels.choose_planes(nodes, planes, radius, limit, measured, np.zeros_like(measured))
    return nodes


def test_exchange_sums_disc_form_factors_with_delays() -> None:
    rng = np.random.default_rng(1)
    sources = rng.normal(size=(30, 9))
    sources[:, 2] += 4
    sources[:, 3:6] /= np.linalg.norm(sources[:, 3:6], axis=1, keepdims=True)
    sources[:, 6] = rng.uniform(0.001, 0.05, 30)
    receivers = rng.normal(size=(6, 200))
    receivers[2] += 4
    receivers[3:] /= np.linalg.norm(receivers[3:], axis=0)
    out = np.zeros((2, 200), np.float32)
    for a, b in ((0, 7), (7, 30)):
        kernels.add_irradiance(
            sources.astype(np.float32), a, b, receivers.astype(np.float32), 10.0, out
        )

    step = receivers[:3].T[None] - sources[:, None, :3]
    d = np.linalg.norm(step, axis=-1)
    leaving = np.einsum("src,sc->sr", step, sources[:, 3:6]) / d
    arriving = -np.einsum("src,rc->sr", step, receivers[3:].T) / d
    area = sources[:, 6:7]
    factor = np.clip(leaving, 0, None) * np.clip(arriving, 0, None) * area / (np.pi * d**2 + area)
    light = (sources[:, 7] + 1j * sources[:, 8])[:, None]
    wanted = (factor * light * np.exp(2j * np.pi * d / 10.0)).sum(0)
    np.testing.assert_allclose(out[0] + 1j * out[1], wanted, rtol=2e-4, atol=2e-6)
    assert (np.abs(wanted) > 0).sum() > 100


def test_block_means_use_median_surface() -> None:
    rays = grid_rays(8, 8)
    z = np.full((8, 8), 2.0, np.float32)
    z[0, :2] = 5.0
    z[1, 0] = 0.0
    light = np.full((8, 8), 10.0)
    light[0, :2] = 900.0
    light[3, 3] = 0.0
    nodes = means(z, rays, light, 4)
    assert nodes.shape == (2, 2, COLUMNS)
    chosen = (z[:4, :4] == 2.0).ravel()
    assert nodes[0, 0, X] == pytest.approx(rays[:4, :4, 0].ravel()[chosen].mean())
    assert nodes[0, 0, Y] == pytest.approx(rays[:4, :4, 1].ravel()[chosen].mean())
    assert nodes[..., W] == pytest.approx(0.5)
    assert nodes[..., AMPLITUDE] == pytest.approx(10.0)
    assert nodes[0, 0, AREA] == pytest.approx(13 * 1e-4, rel=1e-4)
    assert nodes[1, 1, AREA] == pytest.approx(16 * 1e-4, rel=1e-4)


def roof(shape: tuple[int, int] = (24, 32)) -> tuple[np.ndarray, np.ndarray]:
    """Nodes that see two planes meet in a vertical edge at x = 0, and 1 for the right one."""
    rays = grid_rays(*shape, pitch=0.02).astype(float)
    nodes = np.zeros((*shape, COLUMNS))
    nodes[..., X], nodes[..., Y] = rays[..., 0] + 0.01, rays[..., 1]
    right = nodes[..., X] > 0
    nodes[..., W] = 0.3 + np.where(right, 0.3, -0.2) * nodes[..., X]
    return nodes, right


def test_planes_are_fitted_up_to_edges() -> None:
    nodes, right = roof()
    fitted(nodes)
    np.testing.assert_allclose(nodes[..., A], np.where(right, 0.3, -0.2), atol=1e-9)
    np.testing.assert_allclose(nodes[..., B], 0, atol=1e-9)
    np.testing.assert_allclose(nodes[..., C], 0.3, atol=1e-9)


def test_edge_nodes_are_compared_with_corrected_planes() -> None:
    nodes, right = roof()
    length = np.sqrt(1 + nodes[..., X] ** 2 + nodes[..., Y] ** 2)
    true = length / nodes[..., W]
    shift = np.where(right, 0.4, 0.0)
    # The two columns right of the edge have the correction of the left plane.
    strip = right & (nodes[..., X] < 0.04)
    measured = true + shift
    nodes[..., W] = length / np.where(strip, measured, true)
    planes = np.zeros((*nodes.shape[:2], 4))
    kernels.window_planes(nodes, 2, planes)
    kernels.choose_planes(nodes, planes, 3, 0.006, measured, shift)
    kernels.window_planes(nodes, 1, planes)
    kernels.choose_planes(nodes, planes, 2, 0.006, measured, shift)
    inner = nodes[..., X] > 0.02
    assert strip[inner].any()
    np.testing.assert_allclose(nodes[inner & strip][:, A], 0.3, atol=1e-6)
