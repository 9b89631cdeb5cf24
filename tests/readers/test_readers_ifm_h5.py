"""ifm's .h5 recordings, written by h5py in the manufacturer's published layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import made_ifm as made
from camera_files import read_frames
from refused import refused
from tofuse.formats.recordings.open import open_recording

h5py = pytest.importorskip("h5py", reason="the package h5py is not installed")


@pytest.mark.parametrize("model", [0, 2])
def test_h5_matches_stream_of_head(tmp_path: Path, model: int) -> None:
    numbers = made.BOUGUET if model == 0 else made.FISHEYE
    made.make_o3r(tmp_path / "a.data", model, numbers)
    made.make_h5(tmp_path / "b.h5", model=model)
    stream, recording = open_recording(tmp_path / "a.data"), open_recording(tmp_path / "b.h5")
    assert (recording.format, len(recording)) == ("ifm-h5", len(stream))
    np.testing.assert_allclose(np.diff(recording.timestamps), 0.05, atol=1e-6)
    assert recording.warnings == []
    for frame, same in zip(recording, stream, strict=True):
        assert frame.depth_kind == "range"
        np.testing.assert_allclose(frame.depth, same.depth, rtol=1e-6)
        np.testing.assert_allclose(frame.sigma_image, same.sigma_image, rtol=1e-6)
        np.testing.assert_array_equal(frame.amplitude_image, same.amplitude_image)
        np.testing.assert_array_equal(frame.camera.rays(), same.camera.rays())


def test_one_of_several_heads_is_chosen(tmp_path: Path) -> None:
    made.make_h5(tmp_path / "a.h5", heads=2)
    recording = open_recording(tmp_path / "a.h5")
    assert any("others are o3r_tof_1: choose with topic" in w for w in recording.warnings)
    other = open_recording(tmp_path / "a.h5", topic="o3r_tof_1")
    a, b = recording[0], other[0]
    np.testing.assert_allclose(b.depth, a.depth / 2, atol=made.UNIT)
    refused("has no stream o3r_tof_5", tmp_path / "a.h5", topic="o3r_tof_5")


def test_incomplete_files(tmp_path: Path, monkeypatch) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["other"] = np.zeros(3)
    refused("has no stream o3r_tof_0", tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["streams/o3r_tof_0"] = np.zeros(3, [("distance", "u2", (4, 4))])
    refused("has no distanceResolution", tmp_path / "b.h5")
    made.make_h5(tmp_path / "c.h5")
    with h5py.File(tmp_path / "c.h5", "r+") as file:
        rows = file["streams/o3r_tof_0"][:]
        rows["intrinsicCalibModelID"][1] = 9
        rows["distanceResolution"][2] = np.nan
        file["streams/o3r_tof_0"][:] = rows
    read = read_frames(tmp_path / "c.h5", None)
    assert (len(read.frames), read.unread) == (1, 2)
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    refused(r"pip install 'tofuse\[hdf5\]'", tmp_path / "c.h5")
