"""Images that fit once they are turned over again, or their depths are put right."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.geometry.cameras import Pinhole
from tofuse.odometry.mending import (
    Mending,
    glance,
    looks_rescaled,
    looks_turned_over,
    mendings,
    scale_between,
)
from tofuse.recordings.frames import RangeFrame

CAMERA = Pinhole(48, 36, 40.0, 40.0, 20.0, 17.0)
ORDERS = {
    "mirrored left to right": np.s_[:, ::-1],
    "mirrored top to bottom": np.s_[::-1],
    "turned upside down": np.s_[::-1, ::-1],
}


def frame(order=np.s_[:, :], factor=1.0):
    v, u = np.mgrid[:36, :48]
    depth = (1 + 0.02 * u + 0.01 * v).astype(np.float32)
    depth[:9, :6] = 0
    color = np.stack([u, v, u + v], -1).astype(np.uint8)
    return RangeFrame(
        3,
        0.3,
        CAMERA,
        np.ascontiguousarray(depth[order]) * np.float32(factor),
        amplitude_image=np.ascontiguousarray((100.0 + u + 2 * v).astype(np.float32)[order]),
        color_image=np.ascontiguousarray(color[order]),
        sigma_image=np.ascontiguousarray((0.01 * depth)[order]),
    )


@pytest.mark.parametrize("words", ORDERS)
def test_what_was_turned_over_is_turned_back(words):
    wrong = frame(ORDERS[words])
    (mending,) = (m for m in mendings(frame(), wrong, np.eye(4)) if m.words == words)
    mended = mending(wrong)
    for name in ("depth", "amplitude_image", "color_image", "sigma_image"):
        np.testing.assert_array_equal(getattr(mended, name), getattr(frame(), name))
    assert (mended.index, mended.timestamp, mended.camera) == (3, 0.3, CAMERA)


@pytest.mark.parametrize("factor", [10, 0.1, 1000, 1.1])
def test_another_unit_is_noticed_and_undone(factor):
    wrong = frame(factor=factor)
    assert scale_between(frame(), wrong, np.eye(4)) == pytest.approx(1 / factor, rel=1e-5)
    *_, mending = mendings(frame(), wrong, np.eye(4))
    assert f"{factor:.2g} times" in mending.words
    np.testing.assert_allclose(mending(wrong).depth, frame().depth, rtol=1e-5)


def test_the_same_unit_is_no_suspicion():
    assert len(list(mendings(frame(), frame(factor=1.02), np.eye(4)))) == len(ORDERS)
    empty = Mending("empty", factor=0.0)(frame())
    assert scale_between(frame(), empty, np.eye(4)) == 1.0


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_a_glance_tells_what_is_turned_over(order):
    before = glance(frame().z)
    assert np.isnan(before[0, 0])
    assert not looks_turned_over(before, before)
    assert not looks_turned_over(before, glance(np.roll(frame().z, 1, 1)))
    assert looks_turned_over(before, glance(np.roll(frame(order).z, 1, 1)))


@pytest.mark.parametrize(("factor", "rescaled"), [(1.1, True), (0.9, True), (1.02, False)])
def test_a_glance_tells_what_is_rescaled(factor, rescaled):
    before = glance(frame().z)
    assert looks_rescaled(before, glance(frame(factor=factor).z)) is rescaled
    assert not looks_rescaled(before, np.full_like(before, np.nan))
    (only,) = mendings(frame(), frame(factor=1.1), np.eye(4), turned=False)
    assert only.factor == pytest.approx(1 / 1.1, rel=1e-5)
