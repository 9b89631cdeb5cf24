"""The record that readers and writers of geometry share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tofuse.engine.errors import InputError, OutputError
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.formats.geometry.e57 import write_e57
from tofuse.formats.geometry.glb import write_glb, write_gltf
from tofuse.formats.geometry.las import write_las
from tofuse.formats.geometry.obj import write_obj
from tofuse.formats.geometry.pcd import write_pcd
from tofuse.formats.geometry.ply import write_ply

POINTS = np.zeros((3, 3), np.float32)
FACE = np.array([[0, 1, 2]], np.int32)


@pytest.mark.parametrize(
    "write", [write_e57, write_glb, write_gltf, write_las, write_obj, write_pcd, write_ply]
)
def test_every_writer_checks_shapes(tmp_path, write) -> None:
    for record, words in (
        (GeometryRecord(POINTS[:, :2]), "points of shape"),
        (GeometryRecord(POINTS, FACE + 1), "faces of shape"),
        (GeometryRecord(POINTS, FACE[0]), "faces of shape"),
        (GeometryRecord(POINTS, normals=POINTS[:2]), "normals of shape"),
        (GeometryRecord(POINTS, color=np.zeros((3, 4), np.uint8)), "color of shape"),
        (GeometryRecord(POINTS, uv=POINTS), "uv of shape"),
        (GeometryRecord(POINTS, scalars={"sigma": POINTS}), "sigma of shape"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            write(tmp_path / "a.x", record)
        assert "a.x" in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_amplitude_column_aliases() -> None:
    column = np.arange(3, dtype=np.uint16)
    for name in ("amplitude", "intensity", "scalar_Intensity"):
        amplitude = GeometryRecord(POINTS, scalars={"views": column + 1, name: column}).amplitude
        assert amplitude is not None
        assert amplitude.dtype == np.float32
        np.testing.assert_array_equal(amplitude, column)
    assert GeometryRecord(POINTS, scalars={"intensity": np.zeros((3, 2))}).amplitude is None


def test_obj_that_fails_leaves_the_earlier_texture(tmp_path: Path) -> None:
    image, path = tmp_path / "mesh.jpg", tmp_path / "mesh.obj"
    image.write_bytes(b"earlier")
    path.mkdir()  # so that it can't be written
    mesh = GeometryRecord(
        np.eye(3, dtype=np.float32),
        np.array([[0, 1, 2]], np.int32),
        uv=np.zeros((3, 2), np.float32),
        texture=b"\xff\xd8",
    )
    with pytest.raises(OutputError, match=r"mesh\.obj"):
        write_obj(path, mesh)
    assert image.read_bytes() == b"earlier"
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("unknown", [[0.1, np.nan, 0.3], [np.nan] * 3])
def test_e57_keeps_unknown_values(tmp_path: Path, unknown: list[float]) -> None:
    pye57 = pytest.importorskip("pye57")
    path, sigma = tmp_path / "a.e57", np.array(unknown, np.float32)
    write_e57(path, GeometryRecord(POINTS, normals=POINTS * np.nan, scalars={"sigma": sigma}))
    file = pye57.E57(str(path))
    read, buffers = np.empty(3, np.float32), pye57.libe57.VectorSourceDestBuffer()
    buffers.append(pye57.libe57.SourceDestBuffer(file.image_file, "tofuse:sigma", read, 3))
    file.get_header(0)["points"].reader(buffers).read()
    np.testing.assert_array_equal(read, sigma)
    file.close()


def test_full_disk_for_e57(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    resource = pytest.importorskip("resource")
    cloud = GeometryRecord(np.random.default_rng(0).normal(size=(10_000, 3)).astype(np.float32))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, hard))
    try:
        with pytest.raises(OutputError, match=r"a\.e57: can't be written"):
            write_e57(tmp_path / "a.e57", cloud)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())
