from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tofuse.engine.errors import InputError
from tofuse.engine.geometry.se3 import exp
from tofuse.engine.times import MAX_GAP_S, associate, nearest, partners
from tofuse.formats.poses.trajectory import read_tum, tum_text, write_tum


def _poses(n: int = 20) -> np.ndarray:
    return exp(np.random.default_rng(8).normal(size=(n, 6)))


def test_round_trip_in_full_precision(tmp_path: Path) -> None:
    poses = _poses()
    times = 1305031102.175304 + np.arange(20) / 30
    write_tum(tmp_path / "t.txt", times, poses)
    back_times, back = read_tum(tmp_path / "t.txt")
    np.testing.assert_array_equal(back_times, times)
    np.testing.assert_array_equal(back[:, :3, 3], poses[:, :3, 3])
    np.testing.assert_allclose(back, poses, atol=1e-15)


def test_column_order() -> None:
    half = np.sqrt(0.5)
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # 90 degrees about z
    T[:3, 3] = 1, 2, 3
    numbers = [float(v) for v in tum_text([4.5], T[None]).split()]
    np.testing.assert_allclose(numbers, [4.5, 1, 2, 3, 0, 0, half, half])


def test_negative_zero_is_normalized() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, 0, 3] = -0.0
    text = tum_text([0, 1], poses)
    assert text == "0.0 0.0 0.0 0.0 0.0 0.0 0.0 1.0\n1.0 0.0 0.0 0.0 0.0 0.0 0.0 1.0\n"


def test_unknown_poses_are_skipped(tmp_path: Path) -> None:
    poses = _poses(3)
    poses[1] = np.nan
    write_tum(tmp_path / "t.txt", [0, 1, 2], poses)
    times, _ = read_tum(tmp_path / "t.txt")
    assert times.tolist() == [0, 2]
    write_tum(tmp_path / "t.txt", [0], np.full((1, 4, 4), np.nan))
    assert read_tum(tmp_path / "t.txt")[1].shape == (0, 4, 4)


def test_comments_blank_lines_and_scaled_quaternions_are_accepted(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("# head\n\n1 0 0 0 0 0 0 1.001 # tail\r\n")
    times, poses = read_tum(tmp_path / "t.txt")
    assert times.tolist() == [1]
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-15)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1 0 0 0 0 0 0", "has 7 numbers"),
        ("1 0 0 zero 0 0 0 1", "zero"),
        ("nan 0 0 0 0 0 0 1", "not finite"),
        ("1 0 0 inf 0 0 0 1", "not finite"),
        ("1 nan nan nan 0 0 0 1", "not finite.*whole pose"),
        ("1 0 0 1e160 0 0 0 1", "coordinate beyond 1e"),
        ("1 0 0 0 0 0 0 0", "not of unit length"),
        ("1 0 0 0 3 0 0 1", "not of unit length"),
    ],
)
def test_bad_lines_are_reported(tmp_path: Path, line: str, words: str) -> None:
    (tmp_path / "t.txt").write_text(f"# x\n0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(InputError, match=words) as caught:
        read_tum(tmp_path / "t.txt")
    assert "t.txt, line 3" in str(caught.value)


def test_nearest_within_limit() -> None:
    others = [1.0, 0.0, 2.0]  # unsorted
    assert nearest(others, [0.019, 0.981, 1.5, 2.02], 0.02).tolist() == [1, 0, -1, 2]
    assert nearest([0.0, np.nan], [0.0211, 0.5, np.nan], 0.02).tolist() == [-1, -1, -1]
    assert nearest(others, []).tolist() == []
    assert nearest([], [1.0]).tolist() == [-1]


def test_association_matches_slow_search() -> None:
    a, b = np.arange(60) / 30, np.random.default_rng(9).uniform(0, 2, 70)
    a[7] = b[3] = np.nan
    gaps = np.abs(a[:, None] - b)
    expected = []
    while np.nanmin(gaps) < MAX_GAP_S:
        i, j = np.unravel_index(np.nanargmin(gaps), gaps.shape)
        expected.append((i, j))
        gaps[i], gaps[:, j] = np.inf, np.inf
    assert associate(a, b).tolist() == [list(pair) for pair in sorted(expected)]
    found = dict(sorted(expected))
    assert partners(a, b).tolist() == [found.get(i, -1) for i in range(len(a))]
