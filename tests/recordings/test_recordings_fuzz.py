"""Damaged recordings of every format raise only the package's own one-line errors."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from camera_files import MAKERS, OTHERS, read_frames, read_through
from damaged_files import damage
from tofuse.formats.recordings.open import open_recording

# `benchmarks/attack.py` runs any number.
ROUNDS, CUTS = 12, 6
EVERY = MAKERS | OTHERS


def made(name: str, folder: Path) -> tuple[Path, str]:
    """Write the recording of a maker into `folder`; return its path there, and its format."""
    make, file, format_ = EVERY[name]
    path = folder / "freiburg1" / (file or ".")
    (folder if file is None else path.parent).mkdir(parents=True, exist_ok=True)
    make(path)
    return path.relative_to(folder), format_


@pytest.mark.nightly
@pytest.mark.parametrize("name", EVERY)
def test_damage_raises_only_package_errors(tmp_path: Path, name: str) -> None:
    original, copy = tmp_path / "original", tmp_path / "copy"
    path, format_ = made(name, original)
    assert open_recording(original / path).format == format_
    totals = np.zeros(3, int)
    for k in range(ROUNDS):
        rng = np.random.default_rng([70, len(name), k])
        shutil.copytree(original, copy)
        for _ in range(1 + int(rng.integers(2))):
            if files := sorted(p for p in copy.rglob("*") if p.is_file()):
                damage(files, rng)
        totals += read_through(copy / path, format_ if k % 2 else None)
        shutil.rmtree(copy)
    whole, unread, refused = totals
    # Some damage must have been noticed, and some harmless.
    assert unread + refused > 0
    assert whole > 0


@pytest.mark.nightly
@pytest.mark.parametrize("name", MAKERS)
def test_truncated_file_loses_no_frame_silently(tmp_path: Path, name: str) -> None:
    """Frames that are read have the same depth; an error or a warning tells of missing ones."""
    path, format_ = made(name, tmp_path)
    original = read_frames(tmp_path / path, format_)
    files = sorted(p for p in tmp_path.rglob("*") if p.is_file())
    rng = np.random.default_rng([71, len(name)])
    noticed = 0
    for _ in range(CUTS):
        file = files[rng.integers(len(files))]
        data = file.read_bytes()
        file.write_bytes(data[: rng.integers(len(data))])
        read = read_frames(tmp_path / path, format_)
        file.write_bytes(data)
        reported = read.refused or read.unread > 0 or read.warnings != original.warnings
        assert reported or len(read.frames) == len(original.frames)
        noticed += reported
        for frame in read.frames:
            # Files without a number of points may lose some.
            expected = original.frames[frame.index].depth[frame.valid]
            np.testing.assert_allclose(frame.depth[frame.valid], expected, rtol=1e-3)
    assert noticed > 0
