"""The background of a static camera, on hand-made images."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.filters.background import background_surface, moving_object
from tofuse.engine.frames.frames import RangeFrame

ROWS, COLUMNS = 60, 80
CAMERA = Pinhole(width=COLUMNS, height=ROWS, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
V, U = np.mgrid[:ROWS, :COLUMNS]


def frame(z: np.ndarray, index: int = 0) -> RangeFrame:
    return RangeFrame(index, float(index), CAMERA, np.asarray(z, np.float32))


def turning_box(angle: float, background: np.ndarray | float = 3.0) -> tuple[np.ndarray, ...]:
    """z and mask of a square pillar with a vertical axis at 1.2 m, before a background."""
    rays = CAMERA.rays()[..., 0].astype(float)
    corners = 0.2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    c, s = np.cos(angle), np.sin(angle)
    corners = corners @ np.array([[c, s], [-s, c]]) + [0, 1.2]
    z = np.full((ROWS, COLUMNS), np.inf)
    for (xa, za), (xb, zb) in zip(corners, np.roll(corners, -1, 0), strict=True):
        # The ray (x, 1) z meets the side a + t (b - a).
        t = (rays * za - xa) / ((xb - xa) - rays * (zb - za) + 1e-12)
        hit = (t >= 0) & (t <= 1)
        z = np.where(hit, np.minimum(z, za + t * (zb - za)), z)
    seen = np.isfinite(z) & (V >= 12) & (V < 50)
    return np.where(seen, z, background), seen


def turning_box_on_table(angle: float) -> tuple[np.ndarray, ...]:
    """The same pillar on a table at a height at which no jump separates the two."""
    with np.errstate(divide="ignore"):
        table = 0.335 / np.maximum(CAMERA.rays()[..., 1].astype(float), 0)
    pillar, _ = turning_box(angle, np.inf)
    pillar = np.where(V >= 50, pillar[30], pillar)  # its sides are vertical
    return np.minimum(pillar, np.where(table < 1.6, table, 3.0)), pillar < table


def recording(
    count: int = 16, sigma: float = 0.004, background: np.ndarray | float = 3.0
) -> tuple[list[RangeFrame], list[np.ndarray]]:
    rng = np.random.default_rng(3)
    frames, masks = [], []
    for k in range(count):
        z, mask = turning_box(2 * np.pi * k / count * 0.93, background)
        frames.append(frame(np.where(z > 0, z + rng.normal(0, sigma, z.shape), 0), k))
        masks.append(mask)
    return frames, masks


def agreement(found: np.ndarray, true: np.ndarray) -> float:
    return float((found & true).sum() / (found | true).sum())


def test_background_is_farthest_repeated_depth() -> None:
    """Compared with a search through all runs of depths, pixel by pixel."""
    rng = np.random.default_rng(0)
    count = 12
    z = 2 + rng.normal(0, 0.005, (count, ROWS, COLUMNS))
    # Each stripe of columns is hidden in some frames, by something at another depth each time.
    hidden = rng.random((count, 8)) < 0.6
    nearer = rng.uniform(0.5, 1.5, (count, 8))
    stripe = U[0] // 10
    z = np.where(hidden[:, None, stripe], nearer[:, None, stripe], z)
    z[3, :, :40] = 4.0  # a single depth is no surface
    z[:, :5] = 0
    z[:4, :5] = 1.0  # mostly invalid
    background = background_surface([frame(image, k) for k, image in enumerate(z)])
    assert np.isinf(background.z[:5]).all()
    assert np.allclose(background.static_fraction[:5], 8 / 12)
    behind = np.abs(z[:, 5:] - 2) < 0.1
    for s in range(8):
        columns = (stripe == s) & (U[0] % 10 > 1) & (U[0] % 10 < 8)
        times = behind[:, 0, columns][:, 0].sum()
        if times < 3:
            assert not (np.abs(background.z[5:, columns] - 2) < 0.1).any()
            continue
        assert np.abs(background.z[5:, columns] - 2).max() < 0.02
        assert background.static_fraction[5:, columns].mean() == pytest.approx(
            times / count, abs=0.01
        )
        assert np.median(background.sigma[5:, columns]) == pytest.approx(0.005, rel=0.6)
    assert 2 <= sum(behind[:, 0, stripe == s][:, 0].sum() >= 3 for s in range(8)) <= 8


def test_object_includes_pixels_it_always_hides() -> None:
    frames, masks = recording()
    found = moving_object(frames)
    middle = np.zeros((ROWS, COLUMNS), bool)
    middle[20:45, 34:46] = True
    assert found.always_occluded[
        middle
    ].all()  # its depth is constant, or nearly so, and it is no background
    assert not found.always_occluded[:8].any()
    for image, mask in zip(frames, masks, strict=True):
        assert agreement(found.mask(image.z), mask) > 0.97
    assert 0.85 < found.depth_range[0] < 1.1 < found.depth_range[1] < 1.3


def test_static_objects_in_front_are_background() -> None:
    # A shelf as near as the object, at the left border, and a floor that extends to near range.
    frames, masks = recording(background=np.where(U < 14, 1.1, np.where(V > 52, 1.6, 3.0)))
    found = moving_object(frames)
    assert not found.always_occluded[:, :14].any()
    assert not found.always_occluded[53:].any()
    assert min(
        agreement(found.mask(f.z), m) for f, m in zip(frames, masks, strict=True)
    ) > 0.97  # fmt: skip


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("upright", [True, False])
def test_table_is_not_part_of_what_stands_on_it(upright: bool) -> None:
    rng = np.random.default_rng(3)
    camera = (
        CAMERA if upright else Pinhole(width=ROWS, height=COLUMNS, fx=70, fy=70, cx=29.5, cy=39.5)
    )
    frames, masks = [], []
    for k in range(16):
        z, mask = turning_box_on_table(2 * np.pi * k / 16 * 0.93)
        z = z + rng.normal(0, 0.004, z.shape)
        z, mask = (z, mask) if upright else (z.T, mask.T)
        frames.append(RangeFrame(k, float(k), camera, np.asarray(z, np.float32)))
        masks.append(mask)
    found = moving_object(frames)
    for image, mask in zip(frames, masks, strict=True):
        assert agreement(found.mask(image.z), mask) > 0.93


def test_background_without_depth() -> None:
    frames, masks = recording(background=0.0)
    found = moving_object(frames)
    for image, mask in zip(frames, masks, strict=True):
        assert agreement(found.mask(image.z), mask) > 0.95


def test_flickering_wall_gives_no_foreground() -> None:
    frames, masks = recording(sigma=0.03)
    rng = np.random.default_rng(1)
    frames = [
        frame(np.where(rng.random(f.z.shape) < 0.3, 0, f.z) * (f.z > 2) + f.z * (f.z <= 2), f.index)
        for f in frames
    ]
    found = moving_object(frames)
    for image, mask in zip(frames, masks, strict=True):
        assert agreement(found.mask(image.z), mask) > 0.93


def sideways(k: int) -> np.ndarray:
    """A camera that moves along a wall with pillars in front."""
    return np.where((U + 5 * k) % 40 < 18, 1.5, 3.0)


def turning(k: int) -> np.ndarray:
    """A camera that rotates in a room."""
    angle = np.arctan(CAMERA.rays()[..., 0].astype(float)) + 0.3 * k
    return 2.0 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))


@pytest.mark.parametrize(
    ("scene", "why"),
    [
        (sideways, "image borders change"),
        (turning, "image borders change"),
        (lambda _k: np.full((ROWS, COLUMNS), 2.0), "nothing moves in front"),
        # A rotating pillar embedded in a wall: only the parts in front of the wall are visible.
        (lambda k: np.minimum(turning_box(0.37 * k)[0], 1.02), "can't be separated"),
    ],
)
def test_invalid_scenes_are_refused(scene: Callable[[int], np.ndarray], why: str) -> None:
    rng = np.random.default_rng(2)
    frames = [frame(scene(k) + rng.normal(0, 0.004, (ROWS, COLUMNS)), k) for k in range(16)]
    with pytest.raises(InputError, match=why) as caught:
        moving_object(frames)
    assert "max_depth" in str(caught.value)
