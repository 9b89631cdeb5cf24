"""Filters of the laboratory."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.lab.methods.filters_amplitude import Amplitude
from tofuse.lab.methods.filters_box import Box
from tofuse.lab.methods.filters_foreground import Foreground, otsu
from tofuse.lab.methods.filters_mask import Mask
from tofuse.lab.methods.filters_median import Median, local_median
from tofuse.lab.methods.filters_neighbour_distance import NeighbourDistance
from tofuse.lab.methods.filters_temporal import TemporalDeviation, z_deviation

NAN = float("nan")


def frame(z: Any, **images: Any) -> RangeFrame:
    z = np.asarray(z, np.float32)
    h, w = z.shape
    camera = Pinhole(w, h, 230.0, 230.0, (w - 1) / 2, (h - 1) / 2)
    return RangeFrame(0, 0.0, camera, z, **images)


def test_amplitude_window_and_saturation() -> None:
    counts = np.array([[0, 99, 100, 150], [200, 201, 65534, 65535]], np.float32)
    f = frame(np.ones((2, 4)), amplitude_image=counts)
    assert np.array_equal(Amplitude(100, 200).mask(f, ()), (counts >= 100) & (counts <= 200))
    assert np.array_equal(Amplitude().mask(f, ()), counts < 65535)
    counts[0, 0] = np.nan
    assert not Amplitude().mask(f, ())[0, 0]


def test_box_keeps_or_removes_inside() -> None:
    points = np.float32([[0, 0, 1], [1, 1, 2], [1.001, 1, 2], [0, 0, 3]])
    cloud = CloudFrame.of(points)
    box = Box((-1.0, -1.0, 1.0), (1.0, 1.0, 2.0))
    assert box.mask(cloud, ()).tolist() == [True, True, False, False]
    cut = Box((-1.0, -1.0, 1.0), (1.0, 1.0, 2.0), "inside")
    assert cut.mask(cloud, ()).tolist() == [False, False, True, True]
    assert Box((-9.0, -9.0, 1.0), (9.0, 9.0, 2.0)).mask(frame(np.full((3, 3), 1.5)), ()).all()


def test_foreground_is_separated_at_gap() -> None:
    rng = np.random.default_rng(0)
    z = np.full((40, 40), 3.0) + 0.05 * rng.standard_normal((40, 40))
    z[10:30, 12:24] = 1.0 + 0.05 * rng.standard_normal((20, 12))
    z[0, :5] = 0
    keep = Foreground().mask(frame(z), ())
    expected = np.zeros((40, 40), bool)
    expected[10:30, 12:24] = True
    assert np.array_equal(keep & (z > 0), expected)


def test_foreground_keeps_unimodal_depths() -> None:
    rng = np.random.default_rng(1)
    even = frame(rng.uniform(1, 2, (60, 60)))
    bell = frame(2 + 0.1 * rng.standard_normal((60, 60)))
    for f in (even, bell, frame(np.full((4, 4), 2.0)), frame(np.zeros((4, 4)))):
        assert Foreground().mask(f, ()).all()
    assert not Foreground(separability=0.0).mask(even, ()).all()
    assert Foreground(limit=1.5).mask(frame([[1.5, 1.6], [1, 9]]), ()).tolist() == [
        [True, False],
        [True, False],
    ]


def test_otsu_maximises_between_class_variance() -> None:
    rng = np.random.default_rng(2)
    values = np.concatenate([rng.normal(1, 0.1, 300), rng.normal(2, 0.2, 900)]).astype(np.float32)
    limit, eta = otsu(values)

    def between(t: float) -> float:
        low, high = values[values <= t], values[values > t]
        return len(low) * len(high) / len(values) ** 2 * float(low.mean() - high.mean()) ** 2

    best = max(between(t) for t in np.sort(values)[:-1])
    assert between(limit) == pytest.approx(best, rel=1e-3)
    assert eta == pytest.approx(best / float(values.var()), rel=1e-2)
    assert otsu(np.zeros(0, np.float32)) == (np.inf, 0.0)


def test_mask_is_read_from_image(tmp_path: Path) -> None:
    view = frame(np.ones((144, 176)))
    image = np.zeros(view.depth.shape, np.uint8)
    image[30:40, 50:60] = 1
    path = tmp_path / "mask.png"
    cv2.imwrite(str(path), image)
    assert (Mask(str(path)).mask(view, ()) == (image > 0)).all()
    cv2.imwrite(str(path), 255 - image)
    os.utime(path, (0, 0))  # another time, however coarse the clock
    assert (Mask(str(path)).mask(view, ()) == (image < 255)).all()
    cv2.imwrite(str(path), image)
    cv2.imwrite(str(tmp_path / "color.png"), np.dstack([image, 0 * image, 0 * image]))
    assert (Mask(str(tmp_path / "color.png")).mask(view, ()) == (image > 0)).all()
    cv2.imwrite(str(tmp_path / "small.png"), image[:10])
    (tmp_path / "text.png").write_text("no image")
    for name, why in (("small", "176 x 10"), ("text", "not an image"), ("none", "can't be read")):
        with pytest.raises(InputError, match=why):
            Mask(str(tmp_path / f"{name}.png")).mask(view, ())
    with pytest.raises(ValueError, match="empty"):
        Mask("")


def median_twin(z: np.ndarray, size: int) -> np.ndarray:
    half, out = size // 2, np.zeros_like(z)
    for i, j in np.ndindex(z.shape):
        window = z[max(0, i - half) : i + half + 1, max(0, j - half) : j + half + 1]
        if (window > 0).any():
            out[i, j] = np.median(window[window > 0])
    return out


@pytest.mark.parametrize("size", [3, 5, 7])
def test_local_median_uses_valid_pixels(size: int) -> None:
    rng = np.random.default_rng(size)
    z = rng.uniform(0.5, 3, (17, 23)).astype(np.float32)
    z[rng.random(z.shape) < 0.4] = 0
    z[5:15, 5:15] = 0
    assert np.array_equal(local_median(z, size), median_twin(z, size))


def test_median_removes_outliers_and_keeps_steps() -> None:
    z = np.full((20, 20), 2.0)
    z[:, 10:] = 3.0
    z[5, 5] = 2.3
    z[15, 15] = 0.4
    keep = Median(threshold=0.1, size=3).mask(frame(z), ())
    assert not keep[5, 5]
    assert not keep[15, 15]
    assert keep.sum() == 398


def test_neighbour_distance_removes_outliers() -> None:
    points = np.float32([[0, 0, 1], [0.01, 0, 1], [0, 0.01, 1], [0.01, 0.01, 1], [1, 1, 1]])
    keep = NeighbourDistance(0.05, 3).mask(CloudFrame.of(points), ())
    assert keep.tolist() == [True] * 4 + [False]


def test_temporal_deviation_is_sample_deviation_of_z() -> None:
    z = np.zeros((3, 2, 2), np.float32)
    z[:, 0, 0] = [1.0, 1.02, 1.04]  # 20 mm
    z[:, 0, 1] = [1.0, 0, 1.06]  # 42 mm over the two that are valid
    z[:, 1, 0] = [0, 0, 1.0]
    expected = [[0.02, 0.06 / math.sqrt(2)], [NAN, NAN]]
    assert z_deviation(list(z)) == pytest.approx(np.array(expected), abs=1e-6, nan_ok=True)
    frames = [frame(image) for image in z]
    part = TemporalDeviation(0.025, 3)
    assert part.mask(frames[-1], frames[:-1]).tolist() == [[True, False], [True, True]]


def test_temporal_removes_edges_and_keeps_surfaces() -> None:
    """As in the thesis (figure 3.2 c): edges are removed, surfaces facing the camera kept."""
    rng = np.random.default_rng(3)
    frames = []
    for _ in range(6):
        z = np.full((30, 30), 3.0) + 0.01 * rng.standard_normal((30, 30))
        z[8:22, 8:22] = 1.5 + 0.01 * rng.standard_normal((14, 14))
        share = rng.random(14)  # the mixture in a pixel on the edge, random in each frame
        z[8:22, 22] = 1.5 * share + 3.0 * (1 - share)
        frames.append(frame(z))
    keep = TemporalDeviation(0.025, 6).mask(frames[-1], frames[:-1])
    assert not keep[8:22, 22].any()
    keep[8:22, 22] = True
    assert keep.all()
