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


SLANTEST = 0.6


def lit_nodes(rng: np.random.Generator, rows: int, columns: int) -> np.ndarray:
    """Nodes with random planes, constant over four columns; some without one."""
    nodes = np.zeros((rows, columns, COLUMNS))
    y, x = np.mgrid[:rows, :columns] * 0.1
    nodes[..., X], nodes[..., Y] = x - 0.4, y - 0.3
    nodes[..., AMPLITUDE], nodes[..., AREA] = rng.uniform(10, 90, (2, rows, columns)) * 1e-2
    planes = rng.normal(0, 0.3, (rows, -(-columns // 4), 3)).repeat(4, 1)[:, :columns]
    nodes[..., A : C + 1] = planes + np.array([0, 0, 0.6])
    nodes[..., W] = (
        nodes[..., A : C + 1] * np.stack([nodes[..., X], nodes[..., Y], 1 + 0 * x], -1)
    ).sum(-1)
    nodes[rng.random((rows, columns)) < 0.1, A:] = 0
    nodes[rng.random((rows, columns)) < 0.1, W] = 0
    return nodes


def surfaces_of(nodes: np.ndarray, factor: np.ndarray) -> tuple[np.ndarray, ...]:
    shape = nodes.shape[:2]
    good = np.empty(shape, bool)
    points, normals, values = np.empty((*shape, 3)), np.empty((*shape, 3)), np.empty((5, *shape))
    kernels.surface_radiometry(nodes, factor, 4.0, SLANTEST, good, points, normals, values)
    return good, points, normals, values


def test_surface_radiometry_matches_reference() -> None:
    rng = np.random.default_rng(6)
    nodes = lit_nodes(rng, 9, 11)
    factor = rng.uniform(1, 1.5, (9, 11))
    good, points, normals, values = surfaces_of(nodes, factor)
    abc = nodes[..., A : C + 1]
    ray = np.stack([nodes[..., X], nodes[..., Y], np.ones((9, 11))], -1)
    w = (abc * ray).sum(-1)
    np.testing.assert_array_equal(good, (nodes[..., W] > 0) & (abc != 0).any(-1) & (w > 0))
    assert 40 < good.sum() < 99
    for out in (points, normals, np.moveaxis(values, 0, -1)):
        assert not out[~good].any()
    abc, ray, w = abc[good], ray[good], w[good]
    np.testing.assert_allclose(points[good], ray / w[:, None])
    n = -abc / np.linalg.norm(abc, axis=1, keepdims=True)
    np.testing.assert_allclose(normals[good], n)
    length = np.linalg.norm(ray, axis=1)
    cosine = np.clip(-(n * ray).sum(1) / length, SLANTEST, 1)
    assert (cosine == SLANTEST).any()
    r = length / w
    area = nodes[..., AREA][good] / (w**2 * length * cosine)
    lit = length**-2 * cosine / r**2
    radiosity = nodes[..., AMPLITUDE][good] * length**2
    albedo = radiosity / lit / factor[good]
    np.testing.assert_allclose(values[:, good], [r, area, lit, radiosity, albedo])


def test_visible_sources_merge_similar_nodes_of_a_block() -> None:
    rng = np.random.default_rng(7)
    nodes = lit_nodes(rng, 9, 11)
    # Below the rough part, a large wall.
    nodes[4:, :, A:] = [0.02, 0.01, 0.5]
    nodes[4:, :, W] = 0.5
    good, points, normals, values = surfaces_of(nodes, np.ones((9, 11)))
    area = values[1]
    light = rng.normal(size=(9, 11)) + 1j * rng.normal(size=(9, 11))
    light[rng.random((9, 11)) < 0.1] = 0
    out = np.full((99, 9), np.nan, np.float32)
    count = kernels.visible_sources(good, points, normals, area, light, out)
    assert np.isnan(out[count:]).all()

    wanted = []
    together = 0
    for top in range(0, 9, 2):
        for left in range(0, 11, 2):
            block = np.s_[top : top + 2, left : left + 2]
            power = np.where(good, area * np.abs(light), 0)[block].ravel()
            p, n, a, q = (v[block].reshape(len(power), -1) for v in (points, normals, area, light))
            if not power.any():
                continue
            k = power.argmax()
            alike = (n @ n[k] > 0.97) & (np.abs((p - p[k]) @ n[k]) < 0.02 * np.linalg.norm(p[k]))
            alike &= power > 0
            together += alike.sum() > 1
            for one in [
                alike,
                *(np.arange(len(power)) == m for m in np.flatnonzero(~alike & (power > 0))),
            ]:
                normal = power[one] @ n[one]
                sent = (a[one] * q[one]).sum() / a[one].sum()
                wanted.append(
                    [
                        *(power[one] @ p[one] / power[one].sum()),
                        *(normal / np.linalg.norm(normal)),
                        a[one].sum(),
                        sent.real,
                        sent.imag,
                    ]
                )
    assert together > 5
    assert count == len(wanted) > together + 3
    found = out[:count][np.lexsort(out[:count].T)]
    np.testing.assert_allclose(
        found,
        np.array(wanted, np.float32)[np.lexsort(np.array(wanted, np.float32).T)],
        rtol=1e-4,
        atol=1e-6,
    )


def test_offscreen_sources_use_known_or_nearest_border_plane() -> None:
    rng = np.random.default_rng(8)
    border = lit_nodes(rng, 4, 6)
    border = border[(border[..., W] > 0) & (border[..., C] != 0)]
    border_albedo = rng.uniform(0.2, 0.9, len(border))
    rays = rng.uniform(-1.5, 1.5, (80, 2))
    size = rng.uniform(0.01, 0.02, 80)
    planes = rng.normal(0, 0.2, (80, 3)) + np.array([0, 0, 0.5])
    albedo = np.where(rng.random(80) < 0.5, rng.uniform(0.2, 0.9, 80), 0)
    out = np.full((80, 9), np.nan, np.float32)
    growth = np.array([0.5, 2.0])
    count = kernels.offscreen_sources(
        rays, size, planes, albedo, border, border_albedo, growth, 4.0, SLANTEST, 2.5, out
    )
    wanted = []
    guessed = 0
    for ray, cell, abc, light in zip(rays, size, planes, albedo, strict=True):
        line = np.array([*ray, 1.0])
        if light == 0:
            k = ((border[:, [X, Y]] - ray) ** 2).sum(1).argmin()
            abc, light = border[k, A : C + 1], border_albedo[k]
            if not 0.5 <= abc @ line / border[k, W] <= 2.0:
                continue
            guessed += 1
        w = abc @ line
        if w <= 0:
            continue
        n = -abc / np.linalg.norm(abc)
        length = np.linalg.norm(line)
        cosine = np.clip(-n @ line / length, SLANTEST, 1)
        r = length / w
        sent = light * length**-2 * cosine / r**2 * np.exp(2.5j * r)
        wanted.append([*(line / w), *n, cell / (w**2 * length * cosine), sent.real, sent.imag])
    assert guessed > 10
    assert count == len(wanted) > guessed + 20
    np.testing.assert_allclose(out[:count], wanted, rtol=1e-4, atol=1e-6)
    assert np.isnan(out[count:]).all()
    # With an empty border, only the known sources remain.
    none = kernels.offscreen_sources(
        rays, size, planes, albedo, border[:0], border_albedo[:0], growth, 4.0, SLANTEST, 2.5, out
    )
    assert none == count - guessed


def test_projected_patches_average_nearest_front_faces() -> None:
    rng = np.random.default_rng(5)
    pitch = np.array([0.25, 0.2])
    x, y = np.meshgrid(np.arange(-4, 5) * pitch[0], np.arange(-4, 5) * pitch[1])
    rays = np.stack([x.ravel(), y.ravel()], 1)
    rays = rays[np.abs(rays).max(1) > 0.3]
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3] = turn * np.linalg.det(turn)
    T[:3, 3] = 0.3, -0.2, 0.5
    points = rng.uniform((-4, -4, -1), (4, 4, 4), (1500, 3))
    normals = rng.normal(size=(1500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = rng.uniform(0.1, 1, (1500, 2))
    R = T[:3, :3]
    patches = np.concatenate([(points - T[:3, 3]) @ R, normals @ R, light], 1).astype(np.float32)
    planes, albedo = np.zeros((len(rays), 3)), np.zeros(len(rays))
    kernels.project_patches(patches, T, rays, pitch, planes, albedo)

    filled = 0
    for m, ray in enumerate(rays):
        z = np.maximum(points[:, 2], 1e-9)
        seen = points[:, :2] / z[:, None]
        inside = (points[:, 2] > 0.05) & (np.abs(seen - ray) < pitch / 2).all(1)
        line = np.concatenate([seen, np.ones((len(seen), 1))], 1)
        inside &= (normals * line).sum(1) < -0.05 * np.linalg.norm(line, axis=1)
        if not inside.any():
            assert albedo[m] == 0
            continue
        inside &= z < z[inside].min() / 0.8
        weight = light[inside, 1]
        assert albedo[m] == pytest.approx(np.average(light[inside, 0], weights=weight), rel=1e-4)
        direction = np.array([*ray, 1.0])
        mean = weight @ normals[inside]
        if mean @ direction >= 0:
            continue
        filled += 1
        w = np.average(1 / z[inside], weights=weight)
        assert planes[m] @ direction == pytest.approx(w, rel=1e-4)
        across = np.cross(planes[m], mean) / np.linalg.norm(mean)
        assert np.linalg.norm(across) < 1e-4 * np.linalg.norm(planes[m])
    assert 20 < filled < len(rays)
