"""Damaged recordings of cameras and phones raise only the package's own one-line errors."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from camera_files import MAKERS, read_frames, read_through
from damaged_files import damage
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.open import open_recording

# `benchmarks/attack.py` runs any number.
ROUNDS, CUTS = 12, 6


@pytest.mark.slow
@pytest.mark.parametrize("name", MAKERS)
def test_damage_raises_only_package_errors(tmp_path: Path, name: str) -> None:
    make, file, format_ = MAKERS[name]
    original = tmp_path / "original"
    make(original / (file or "."))
    assert open_recording(original / (file or ".")).format == format_
    totals = np.zeros(3, int)
    for k in range(ROUNDS):
        rng = np.random.default_rng([70, len(name), k])
        copy = tmp_path / "copy"
        shutil.copytree(original, copy)
        for _ in range(1 + int(rng.integers(2))):
            if files := sorted(p for p in copy.rglob("*") if p.is_file()):
                damage(files, rng)
        totals += read_through(copy / (file or "."), format_ if k % 2 else None)
        shutil.rmtree(copy)
    whole, unread, refused = totals
    # Some damage must have been noticed, and some harmless.
    assert unread + refused > 0
    assert whole > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", MAKERS)
def test_truncated_file_loses_no_frame_silently(tmp_path: Path, name: str) -> None:
    """Frames that are read have the same depth; an error or a warning tells of missing ones."""
    make, file, format_ = MAKERS[name]
    folder = tmp_path / "original"
    make(folder / (file or "."))
    original = read_frames(folder / (file or "."), format_)
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    rng = np.random.default_rng([71, len(name)])
    noticed = 0
    for _ in range(CUTS):
        path = files[rng.integers(len(files))]
        data = path.read_bytes()
        path.write_bytes(data[: rng.integers(len(data))])
        read = read_frames(folder / (file or "."), format_)
        path.write_bytes(data)
        reported = read.refused or read.unread > 0 or read.warnings != original.warnings
        assert reported or len(read.frames) == len(original.frames)
        noticed += reported
        for frame in read.frames:
            whole = original.frames[frame.index]
            assert isinstance(frame, RangeFrame)
            assert isinstance(whole, RangeFrame)
            # Files without a number of points may lose some.
            valid = frame.valid
            np.testing.assert_allclose(frame.depth[valid], whole.depth[valid], rtol=1e-3)
    assert noticed > 0
