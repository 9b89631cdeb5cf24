"""The distortion of a lens, fitted to the rays of its pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.cameras import projection_kernels
from tofuse.engine.cameras.cameras import BrownConrady, Fisheye, Pinhole, Rational, RayTable
from tofuse.engine.cameras.lens import UNDISTORTED, fitted, moved_rays

PICO = BrownConrady(224, 171, 211.8, 211.8, 117.6, 87.2, k1=0.36, k2=-3.4, k3=6.4)
AZURE = Rational(
    320, 288, 252.0, 252.0, 165.0, 170.0, k1=0.548, k2=-0.026, k3=-0.0025, k4=0.88, k5=0.1, k6=-0.02
)
FISHEYE = Fisheye(160, 120, 100.0, 100.0, 80.0, 60.0, k1=-0.02)


def test_coefficients_of_a_lens_without_tangential_distortion_are_found() -> None:
    # (1 + k1 s + k2 s^2 + k3 s^3) (1 + s)
    expected = (1 + 0.36, 0.36 - 3.4, -3.4 + 6.4, 6.4, np.nanmax((PICO.rays() ** 2).sum(-1)))
    for camera in (PICO, replace(PICO, fy=230.0)):
        np.testing.assert_allclose(fitted(camera.rays()), expected, rtol=0.05)
    pinhole = Pinhole(160, 120, 140.0, 150.0, 79.5, 59.5)
    np.testing.assert_array_equal(fitted(pinhole.rays()), UNDISTORTED)


@pytest.mark.parametrize("camera", [PICO, AZURE, FISHEYE])
def test_pixels_are_those_of_the_distorted_rays(camera: Pinhole) -> None:
    rays = camera.rays().astype(float)
    r2 = (rays**2).sum(-1)
    factor = np.polyval([*fitted(camera.rays())[3::-1], 1], r2) / (1 + r2)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    known = np.isfinite(r2)

    def misfit(x, y):
        """Pixels from where a principal point and a focal length put them."""
        ones, zeros = np.ones(known.sum()), np.zeros(known.sum())
        columns = np.stack([np.r_[x, y], np.r_[ones, zeros], np.r_[zeros, ones]], 1)
        pixels = np.r_[u[known], v[known]]
        return np.abs(columns @ np.linalg.lstsq(columns, pixels, rcond=None)[0] - pixels)

    x, y = rays[known].T
    off = misfit(x * factor[known], y * factor[known])
    assert np.quantile(off, 0.99) < 0.05 * np.quantile(misfit(x, y), 0.99)


@pytest.mark.parametrize("camera", [PICO, AZURE, FISHEYE, Pinhole(160, 120, 140, 150, 79.5, 59.5)])
def test_moved_rays_are_those_of_other_intrinsics(camera: Pinhole) -> None:
    """A table of rays is corrected as the camera that it came from."""
    focal, x, y = 0.03, 0.02, -0.01
    fx, fy = camera.fx / (1 + focal), camera.fy / (1 + focal)
    true = replace(camera, fx=fx, fy=fy, cx=camera.cx - x * fx, cy=camera.cy - y * fy).rays()
    moved = moved_rays(RayTable(camera.rays()).rays(), focal, (x, y))
    off = np.linalg.norm(moved - true, axis=-1)
    changed = np.linalg.norm(camera.rays() - true, axis=-1)
    both = np.isfinite(off) & np.isfinite(changed)
    assert np.quantile(off[both] / changed[both], 0.9) < 0.1


def test_pixels_with_an_unknown_ray_stay_unknown() -> None:
    rays = PICO.rays().copy()
    rays[5, 7] = np.nan
    np.testing.assert_allclose(fitted(rays), fitted(PICO.rays()), rtol=1e-3)
    moved = moved_rays(rays, 0.01, (0.0, 0.0))
    assert np.isnan(moved[5, 7]).all()
    assert np.isfinite(moved).sum() == 2 * (224 * 171 - 1)


def test_rays_beyond_the_image_are_distorted_as_at_its_border() -> None:
    """Points that project far outside are compared, too: no pole and no fold may reach them."""
    lens = fitted(PICO.rays())
    far = np.float32(1e8)
    assert projection_kernels.distortion(far, lens) == projection_kernels.distortion(lens[4], lens)
    assert projection_kernels.bend(far, lens) == 0
    assert np.isfinite(projection_kernels.undistorted(far, -far, far, -far, lens)).all()
