from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from tofuse.engine.errors import InputError
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.formats.geometry import ply as plys
from tofuse.formats.geometry.ply import read_ply, write_ply

CUBE = """ply
format ascii 1.0
comment made by hand
element vertex 4
property double x
property double y
property float z
property uchar red
property uchar green
property uchar blue
element face 2
property list uchar int vertex_indices
property float quality
element edge 1
property int vertex1
property int vertex2
end_header
0 0 0 255 0 0
1 0 0 0 255 0
1 1 0 0 0 255
0 1 0.5 9 9 9
3 0 1 2 0.5
4 0 1 2 3 0.25
0 1
"""


def test_ascii_with_polygons_and_other_elements_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(CUBE)
    ply = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(ply.points, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]])
    assert ply.faces is not None
    assert ply.faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]
    assert ply.color is not None
    assert ply.color[1].tolist() == [0, 255, 0]
    assert ply.comments == ("made by hand",)


def test_lists_of_vertices_are_named(tmp_path: Path) -> None:
    with_lists = CUBE.replace(
        "property float z\n", "property float z\nproperty list uchar int near\n"
    )
    (tmp_path / "a.ply").write_text(with_lists)
    with pytest.raises(InputError, match="has vertices with lists; export it without"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("order", ["<", ">"])
def test_both_byte_orders_and_mixed_types_are_read(tmp_path: Path, order: str) -> None:
    name = {"<": "little", ">": "big"}[order]
    header = (
        f"ply\r\nformat binary_{name}_endian 1.0\r\nelement camera 1\r\nproperty short a\r\n"
        "element vertex 2\r\nproperty double x\r\nproperty float y\r\nproperty short z\r\n"
        "element face 2\r\nproperty list uint uint vertex_index\r\nend_header\r\n"
    )
    body = struct.pack(order + "h", 5)
    for x, y, z in ((1.5, 2.5, -3), (4.5, 5.5, 6)):
        body += struct.pack(order + "dfh", x, y, z)
    body += struct.pack(order + "IIIII", 4, 0, 1, 0, 1) + struct.pack(order + "IIII", 3, 1, 0, 1)
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    ply = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(ply.points, [[1.5, 2.5, -3], [4.5, 5.5, 6]])
    assert ply.faces is not None
    assert ply.faces.tolist() == [[0, 1, 0], [0, 0, 1], [1, 0, 1]]


def test_all_attributes_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    points = rng.normal(size=(100, 3)).astype(np.float32)
    normals = rng.normal(size=(100, 3)).astype(np.float32)
    color = rng.integers(0, 256, (100, 3), np.uint8)
    faces = rng.integers(0, 100, (50, 3))
    views = rng.integers(0, 9, 100)
    amplitude = rng.normal(size=100)
    scalars = {"amplitude": amplitude, "views": views}
    record = GeometryRecord(points, normals=normals, color=color, scalars=scalars, faces=faces)
    write_ply(tmp_path / "a.ply", record)
    ply = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(ply.points, points)
    np.testing.assert_array_equal(ply.normals, normals)
    np.testing.assert_array_equal(ply.color, color)
    np.testing.assert_array_equal(ply.faces, faces)
    np.testing.assert_array_equal(ply.scalars["views"], views)
    np.testing.assert_array_equal(ply.scalars["amplitude"], amplitude)
    first = (tmp_path / "a.ply").read_bytes()
    write_ply(tmp_path / "a.ply", record)
    assert (tmp_path / "a.ply").read_bytes() == first


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ply\n", "plx\n", "not a PLY"),
        ("element vertex 4", "element vertex 400000000000", "cut off"),
        ("element vertex 4", "element vertex -4", "invalid PLY header line"),
        ("element vertex 4", "element vertex many", "invalid PLY header line"),
        ("property double x", "property huge x", "invalid PLY header line"),
        ("property double x", "property double w", "no vertices with x"),
        ("property double x", "property double y", "declares 'y' twice"),
        ("format ascii", "format morse", "format 'morse'"),
        ("end_header", "end", "without an end"),
        ("4 0 1 2 3 0.25", "4 0 1 2 9 0.25", "indices outside 0 to 3"),
        ("4 0 1 2 3 0.25", "400 0 1 2 3 0.25", "too short"),
        ("1 1 0 0 0 255", "1 1 zero 0 0 255", "damaged"),
    ],
)
def test_bad_files_are_rejected(tmp_path: Path, old: str, new: str, words: str) -> None:
    (tmp_path / "a.ply").write_text(CUBE.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        read_ply(tmp_path / "a.ply")
    assert "a.ply" in str(caught.value)


def test_truncated_binary_is_rejected(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", GeometryRecord(np.ones((10, 3)), faces=np.zeros((4, 3), int)))
    data = (tmp_path / "a.ply").read_bytes()
    for cut in (1, 60, len(data) - 100):
        (tmp_path / "a.ply").write_bytes(data[:-cut])
        with pytest.raises(InputError):
            read_ply(tmp_path / "a.ply")


def test_blockwise_writing_gives_same_bytes(tmp_path: Path, monkeypatch) -> None:
    rng = np.random.default_rng(0)
    points, faces = rng.normal(size=(23, 3)), rng.integers(0, 23, (41, 3))
    more = {"color": rng.integers(0, 256, (23, 3)), "scalars": {"views": np.arange(23)}}
    write_ply(tmp_path / "a.ply", GeometryRecord(points, faces=faces, **more))
    for at_once in (1, 7, 23, 41):
        monkeypatch.setattr(plys, "_BLOCK_ROWS", at_once)
        write_ply(tmp_path / "b.ply", GeometryRecord(points, faces=faces, **more))
        assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
    write_ply(tmp_path / "b.ply", GeometryRecord(points[:0], faces=faces[:0]))
    assert len(read_ply(tmp_path / "b.ply")) == 0
