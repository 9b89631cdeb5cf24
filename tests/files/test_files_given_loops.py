"""Loop closures given in a file."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.formats.poses.pose import read_loops


def test_loops_from_file(tmp_path):
    file = tmp_path / "loops.txt"
    file.write_text(
        f"# seen by eye\n\n0 56\n12 3   # the other way round\n"
        f"5 30 1 2 3 0 0 {np.sin(0.2)} {np.cos(0.2)}\n"
        f"31 5 1 2 3 0 0 {np.sin(0.2)} {np.cos(0.2)}\n"
    )
    first, second, third, fourth = read_loops(file, range(57))
    assert (first.i, first.j, first.T_i_j) == (0, 56, None)
    assert (second.i, second.j) == (3, 12)
    T = se3.exp([0, 0, 0, 0, 0, 0.4])
    T[:3, 3] = [1, 2, 3]
    assert (third.i, third.j) == (5, 30)
    np.testing.assert_allclose(third.T_i_j, T, atol=1e-12)
    # T_31_5 was given, T_5_31 is kept.
    assert (fourth.i, fourth.j) == (5, 31)
    np.testing.assert_allclose(fourth.T_i_j @ T, np.eye(4), atol=1e-12)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("1", "has 1 value"),
        ("1 2 3", "has 3 values"),
        ("a 2", "is not understood"),
        ("1.5 2", "is not understood"),
        ("4 4", "joins frames 4 and 4"),
        ("-1 4", "joins frames -1 and 4"),
        ("1 99", "there is no frame 99"),
        ("3 0", "is given twice"),
        ("1 2 0 0 0 0 0 0 0", "is not a rigid motion"),
        ("1 2 nan 0 0 0 0 0 1", "is not a rigid motion"),
        ("1 2 0 0 0 0 0 x 1", "is not understood"),
    ],
)
def test_invalid_line_is_named(tmp_path, line, problem):
    file = tmp_path / "loops.txt"
    file.write_text(f"0 3\n{line}\n")
    with pytest.raises(InputError) as caught:
        read_loops(file, range(10))
    assert str(caught.value).startswith(f"{file}, line 2: ")
    assert problem in str(caught.value)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        read_loops(tmp_path / "nowhere.txt")
