"""Damaged recordings raise only the package's own errors."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from damaged_files import damage, make_native, make_pcd, make_ply, make_slam6d, make_xyz
from made_recordings import (
    make_7scenes,
    make_redwood,
    make_sr4000,
    make_tum,
)
from tofuse.errors import TofuseError
from tofuse.recordings.open import open_recording


def make_sr4000_folder(folder: Path) -> None:
    make_sr4000(folder, 2)


MAKERS: dict[str, Callable[[Path], None]] = {
    "native": make_native,
    "sr4000": make_sr4000_folder,
    "tum": make_tum,
    "7scenes": make_7scenes,
    "redwood": make_redwood,
    "pcd": make_pcd,
    "ply": make_ply,
    "xyz": make_xyz,
    "slam6d": make_slam6d,
}
ROUNDS = 12  # `benchmarks/attack.py` runs any number


@pytest.mark.slow
@pytest.mark.parametrize("name", MAKERS)
def test_damage_raises_only_package_errors(tmp_path: Path, name: str) -> None:
    original = tmp_path / "freiburg1"
    MAKERS[name](original)
    assert open_recording(original).format == name
    refused = unread = whole = longest = 0
    for k in range(ROUNDS):
        rng = np.random.default_rng([30, len(name), k])
        copy = tmp_path / "copy" / "freiburg1"
        shutil.copytree(original, copy)
        for _ in range(1 + int(rng.integers(2))):
            damage(sorted(p for p in copy.rglob("*") if p.is_file()), rng)
        try:
            for item in open_recording(copy, format=name if k % 2 else None).read_all():
                if isinstance(item, TofuseError):
                    unread += 1
                    longest = max(longest, len(str(item).splitlines()))
                else:
                    assert np.isfinite(item.points).all()
                    whole += 1
        except TofuseError as error:
            refused += 1
            longest = max(longest, len(str(error).splitlines()))
        shutil.rmtree(copy)
    # Some damage must have been noticed, and some harmless.
    assert longest == 1
    assert refused + unread > 0
    assert whole > 0
    assert refused + unread < 3 * ROUNDS
