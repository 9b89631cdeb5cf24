from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tofuse.engine.errors import InputError
from tofuse.formats.files.reading import files_with, list_folder, read_text
from tofuse.formats.files.tables import read_columns, read_numbers, write_columns


def test_numbers_are_read_with_any_separator(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"# x y\n1, 2;3\n\n4\t5 6 # end\r\n")
    np.testing.assert_array_equal(read_numbers(tmp_path / "a.txt"), [[1, 2, 3], [4, 5, 6]])


def test_missing_values_of_windows_programs(tmp_path: Path) -> None:
    words = [
        "nan",
        "-nan(ind)",
        "nan(snan)",
        "1.#QNAN",
        "-1.#IND00",
        "1.#QO",
        "-1.#IO",
        "1.#R",
        "-1.$",
        "1.#INF",
        "1.#J",
    ]
    (tmp_path / "a.xyz").write_text("".join(f"{word} 1.5 2.5 # 1.#\n" for word in words))
    table = read_numbers(tmp_path / "a.xyz")
    assert np.isnan(table[:, 0]).all()
    np.testing.assert_array_equal(table[:, 1:], [[1.5, 2.5]] * len(words))
    (tmp_path / "a.csv").write_text("a,b\n-1.#IND,2\n")
    np.testing.assert_array_equal(read_columns(tmp_path / "a.csv")["a"], [np.nan])


def test_header_of_cloudcompare_is_a_comment(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text("//X Y Z\n1 2 3\n")
    np.testing.assert_array_equal(read_numbers(tmp_path / "a.xyz"), [[1, 2, 3]])


@pytest.mark.parametrize("text", ["1,5 2,5 3,5\n", "x;y\n-1,5;2,5\n", "1,5\t-2,5\n"])
def test_decimal_commas_are_no_separators(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=r"a\.csv: writes numbers with commas \(1,5\)"):
        read_numbers(tmp_path / "a.csv")


@pytest.mark.parametrize("text", ["1 2\n3\n", "1 b\n", "1 2\n3 4 5\n", "1 nan(x)\n", "\0\0\0\0"])
def test_bad_numbers_are_rejected(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(InputError, match=r"a\.txt"):
        read_numbers(tmp_path / "a.txt")


def test_empty_file_has_no_rows(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("# nothing\n")
    assert read_numbers(tmp_path / "a.txt").size == 0


def test_columns_round_trip(tmp_path: Path) -> None:
    columns = {"integration_us": np.array([100.0, 200.0]), "temperature_c": np.array([41.25, 0.1])}
    write_columns(tmp_path / "a.csv", columns)
    back = read_columns(tmp_path / "a.csv")
    assert list(back) == list(columns)
    for name, column in columns.items():
        np.testing.assert_array_equal(back[name], column)


@pytest.mark.parametrize("text", ["", "a,a\n1,2\n", "a,b\n1\n", "a,b\n1,x\n"])
def test_bad_columns_are_rejected(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=r"a\.csv"):
        read_columns(tmp_path / "a.csv")


def test_files_are_in_natural_order(tmp_path: Path) -> None:
    for name in ("f10.png", "f9.png", "f1.PNG", ".hidden.png", "a.txt"):
        (tmp_path / name).touch()
    assert [p.name for p in files_with(tmp_path, ".png")] == ["f1.PNG", "f9.png", "f10.png"]
    assert len(list_folder(tmp_path)) == 4


def test_text_of_windows_is_read(tmp_path: Path) -> None:
    for encoding in ("utf-8-sig", "utf-16"):
        (tmp_path / "a.txt").write_bytes("1 2\r\n".encode(encoding))
        np.testing.assert_array_equal(read_numbers(tmp_path / "a.txt"), [[1, 2]])


def test_non_text_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"abc\xff\xfe\xff")
    with pytest.raises(InputError, match="byte 3"):
        read_text(tmp_path / "a.txt")
    with pytest.raises(InputError, match="MiB"):
        read_text(tmp_path / "a.txt", limit=3)
