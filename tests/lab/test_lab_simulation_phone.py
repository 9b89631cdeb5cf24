"""The simulated phone: a recording that an app could have written, and its truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import scaled
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.formats.poses import read_tum
from tofuse.formats.recordings import open_recording
from tofuse.lab.demo import simulate_to
from tofuse.lab.simulation import phone

IDEAL = phone.PhoneErrors().without("all")
SMALL = scaled(phone.COLOR, 360, 270)


def made(errors: phone.PhoneErrors = IDEAL, frames: int = 4) -> phone.PhonePlan:
    planned = phone.plan_phone("room", frames=frames, errors=errors)
    return replace(planned, color=SMALL, color_every=3)


def test_app_folder_is_read_with_colour_and_the_phones_poses(tmp_path: Path) -> None:
    planned = made()
    phone.write_phone(planned, tmp_path / "scan")
    recording = open_recording(tmp_path / "scan")
    assert recording.format == "3dscannerapp"
    frames = [recording.image(k) for k in range(len(recording))]
    assert [f is not None and f.color_image is not None for f in frames] == [
        True,
        False,
        False,
        True,
    ]
    assert recording.reference is not None
    assert max(displacement(recording.reference, planned.poses)) < 1e-4
    times, truth = read_tum(tmp_path / "scan" / "truth" / "groundtruth.txt")
    np.testing.assert_allclose(times, recording.source.timestamps)
    np.testing.assert_allclose(truth, planned.poses, atol=1e-6)


def colors_at(planned: phone.PhonePlan, a: int, b: int) -> tuple[Float64, Float64]:
    """Return the colours of points of frame `a` in its own image, and in that of frame `b`."""
    frames = list(planned.frames())
    z = frames[a].depth / 1000.0
    points = (homogeneous(phone.DEPTH.rays()) * z[..., None])[::4, ::4]
    points = points[z[::4, ::4] > 0]
    T_b_a = se3.inverse(planned.poses[b]) @ planned.poses[a]
    out, seen = [], np.ones(len(points), bool)
    for k, T in ((a, np.eye(4)), (b, T_b_a)):
        moved = se3.transform(T, points)
        pixels = moved[:, :2] / moved[:, 2:] * [SMALL.fx, SMALL.fy] + [SMALL.cx, SMALL.cy]
        near = np.round(pixels).astype(int)
        seen &= (moved[:, 2] > 0) & (near >= 0).all(1) & (near < [SMALL.width, SMALL.height]).all(1)
        image = frames[k].color
        assert image is not None
        column, row = near.clip(0, [SMALL.width - 1, SMALL.height - 1]).T
        out.append(image[row, column].astype(float))
    return out[0][seen], out[1][seen]


def test_a_point_has_one_colour_in_all_images_until_exposure_follows() -> None:
    a, b = colors_at(made(), 0, 3)
    assert len(a) > 500
    assert np.median(abs(a - b)) <= 2 < np.median(abs(a - b[::-1]))
    assert np.median(a / b) == pytest.approx(1, abs=0.002)
    turned = phone.plan_phone("room", every=40, frames=2, errors=replace(IDEAL, exposure=1.0))
    a, b = colors_at(replace(turned, color=SMALL, color_every=1), 0, 1)
    assert np.median(a / b) != pytest.approx(1, abs=0.01)


def test_drift_grows_with_time_and_relocalization_jumps() -> None:
    times = np.arange(0, 200, 0.2)
    still = np.tile(np.eye(4), (len(times), 1, 1))

    def errors(**strengths: float) -> Float64:
        found = [
            phone.drifting(still, times, replace(IDEAL, **strengths), np.random.default_rng(k))
            for k in range(40)
        ]
        return np.sqrt((np.stack(found)[:, :, :3, 3] ** 2).sum(2).mean(0))

    drift = errors(drift=1.0)
    assert drift[-1] == pytest.approx(2 * drift[len(times) // 4], rel=0.35)  # by the root of time
    jump = errors(jump=1.0)
    assert jump[len(times) // 2 - 1] == 0
    assert jump[-1] == pytest.approx(0.1)


def test_depth_is_late_smooth_and_wrong_as_stated() -> None:
    ideal = next(iter(made(frames=1).frames())).depth.astype(float)
    wrong = next(iter(made(replace(IDEAL, depth=0.01), frames=1).frames())).depth
    assert (wrong / ideal - 1).std() == pytest.approx(0.01, rel=0.4)
    planned = made(replace(IDEAL, lag=0.2))
    late = list(planned.frames())[1].depth.astype(float)  # 0.2 s after the first
    np.testing.assert_allclose(late, ideal, atol=1)


def test_command_writes_the_same_recording_and_refuses_what_phones_lack(tmp_path: Path) -> None:
    assert simulate_to("rail", tmp_path / "a", camera="phone", frames=2, without=("drift",)) == 2
    assert sorted(p.name for p in (tmp_path / "a").glob("frame*")) == [
        "frame_00000.jpg", "frame_00000.json", "frame_00001.json",
    ]  # fmt: skip
    with pytest.raises(InputError, match="mirror"):
        simulate_to("rail", tmp_path / "b", camera="phone", mirror=(1.0, 1.0))
    with pytest.raises(InputError, match="sigma: the scene room doesn't have this; omit it"):
        simulate_to("room", tmp_path / "b", sigma=0.1)
    with pytest.raises(InputError, match="imu: the scene peaks doesn't have this"):
        simulate_to("peaks", tmp_path / "b", imu=True)
    with pytest.raises(InputError, match="no error called 'rain'"):
        simulate_to("rail", tmp_path / "b", camera="phone", without=("rain",))
    with pytest.raises(InputError, match="the camera stands"):
        simulate_to("torso", tmp_path / "b", camera="phone")
    assert not (tmp_path / "b").exists()
