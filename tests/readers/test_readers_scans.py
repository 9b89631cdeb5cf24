"""Readers of ScanNet's .sens, and of LAS, LAZ and E57 scans."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

import tofuse
from damaged_files import make_ptx
from made_phones import jpeg
from made_sens import BASELINE_M, COLORS, DEPTH, HEIGHT, WIDTH, make_scannet, make_sens, pose
from refused import refused
from tofuse.engine.errors import InputError, UnreadableFrameError
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.geometry.quaternion import to_matrix
from tofuse.formats.geometry.e57 import write_e57
from tofuse.formats.geometry.las import write_las


def image(recording: tofuse.Recording, k: int) -> RangeFrame:
    frame = recording[k]
    assert isinstance(frame, RangeFrame)
    return frame


@pytest.mark.parametrize("depth", ["zlib", "raw"])
@pytest.mark.parametrize("color", ["jpeg", "png", "raw"])
def test_sens(tmp_path: Path, depth: str, color: str) -> None:
    make_sens(tmp_path / "scene.sens", depth=depth, color=color)
    recording = tofuse.open(tmp_path / "scene.sens")
    assert (recording.format, len(recording)) == ("sens", 3)
    assert np.allclose(recording.timestamps, (33_333 * np.arange(3) + 10) / 1e6)
    for k in range(3):
        frame = image(recording, k)
        assert np.allclose(frame.depth, DEPTH[k] / 1000.0)
        assert frame.depth_kind == "z"
        assert frame.camera.rays()[2, 7] == pytest.approx([(7 - 19.5) / 35, (2 - 14.5) / 35])
        seen = frame.color_image[frame.color_image.any(-1)]
        assert len(seen) > 0.3 * WIDTH * HEIGHT
        assert np.abs(seen.astype(int) - COLORS[k]).max() <= 8  # JPEG
    reference = recording.reference
    assert np.allclose(reference[2], pose(2))
    assert np.isnan(reference[1]).all()  # lost


def test_sens_color_is_projected_from_its_own_camera(tmp_path: Path) -> None:
    """A point at the depth camera's left edge is not visible to a camera to its right."""
    make_sens(tmp_path / "scene.sens", color="raw")
    frame = image(tofuse.open(tmp_path / "scene.sens"), 0)
    assert frame.color_image is not None
    v, u = np.nonzero(frame.valid)
    x = frame.point_image[v, u, 0] - BASELINE_M
    column = 70.0 * x / frame.point_image[v, u, 2] + 39.5
    outside = np.rint(column) < 0
    assert outside.any()
    assert not frame.color_image[v, u][outside].any()


def test_exported_sens_is_the_same_recording(tmp_path: Path) -> None:
    make_sens(tmp_path / "scene.sens", color="jpeg")
    make_scannet(tmp_path / "scene0000_00")
    original, export = (tofuse.open(tmp_path / name) for name in ("scene.sens", "scene0000_00"))
    assert export.format == "scannet"
    np.testing.assert_allclose(export.reference, original.reference)
    np.testing.assert_allclose(np.diff(export.timestamps), 1 / 30)
    for k in range(3):
        np.testing.assert_allclose(image(export, k).points, image(original, k).points, rtol=1e-6)
        np.testing.assert_array_equal(image(export, k).color_image, image(original, k).color_image)
        assert image(export, k).color_registered
    # Colour reduced to other pixels than those of its lens.
    for path in (tmp_path / "scene0000_00" / "color").iterdir():
        path.write_bytes(jpeg(np.zeros((30, 40, 3), np.uint8)))
    export = tofuse.open(tmp_path / "scene0000_00")
    assert export.warnings == ["the lens of color/ is of images of another size: colour is ignored"]


def test_invalid_sens_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.sens"
    make_sens(path)
    data = bytearray(path.read_bytes())
    at = data.index(b"StructureSensor") + 15 + 256 + 16
    data[at : at + 8] = struct.pack("<2I", 100_000, 100_000)
    path.write_bytes(data)
    refused("depth images", path)


def test_sens_zip_bomb_is_one_unreadable_frame(tmp_path: Path) -> None:
    """Depth that decompresses to more than the image size is not decompressed."""
    import zlib

    path = tmp_path / "scene.sens"
    make_sens(path)
    data = path.read_bytes()
    old = zlib.compress(DEPTH[0].astype("<u2").tobytes())
    bomb = zlib.compress(bytes(50_000_000))[: len(old)].ljust(len(old), b"\0")
    path.write_bytes(data.replace(old, bomb))
    recording = tofuse.open(path)
    with pytest.raises(UnreadableFrameError, match="bytes of depth"):
        recording[0]
    assert np.allclose(image(recording, 2).depth, DEPTH[2] / 1000.0)


POINTS = np.random.default_rng(91).uniform(-3, 3, (500, 3))
RGB = np.random.default_rng(92).integers(0, 256, (500, 3)).astype(np.uint8)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_written_by_laspy(tmp_path: Path, suffix: str) -> None:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(version="1.2", point_format=2)
    header.scales = np.full(3, 1e-4)
    for k in range(2):
        data = laspy.LasData(header)
        data.x, data.y, data.z = (POINTS + k).T
        data.intensity = np.arange(500)
        data.red, data.green, data.blue = RGB.astype(np.uint16).T * 256
        data.write(tmp_path / f"{k}{suffix}")
    recording = tofuse.open(tmp_path)
    assert (recording.format, len(recording)) == ("las", 2)
    frame = recording[1]
    assert isinstance(frame, CloudFrame)
    assert np.allclose(frame.points, POINTS + 1, atol=1e-4)
    assert frame.amplitude[7] == 7
    assert np.array_equal(frame.color, RGB)


def test_z_of_las_is_up_wherever_the_points_are(tmp_path: Path) -> None:
    """A tile of a map may lie above zero as a whole, like what a camera sees along z."""
    points = POINTS + np.array([0, 0, 9 - POINTS[:, 2].min()])
    result = tofuse.reconstruct(tofuse.open(written(tmp_path / "a.las", points)))
    assert np.allclose(result.T_up_world[1, :3], [0, 0, 1])


def written(path: Path, points: np.ndarray = POINTS, **header: object) -> Path:
    """A file of points as laspy writes it."""
    laspy = pytest.importorskip("laspy")
    data = laspy.LasData(laspy.LasHeader(version="1.2", point_format=2))
    for name, value in header.items():
        setattr(data.header, name, value)
    data.x, data.y, data.z = points.T
    data.write(path)
    return path


def test_map_coordinates_keep_millimetre_precision(tmp_path: Path) -> None:
    """Easting and northing exceed float32 precision: the frame has the shift to them."""
    where = np.array([453_210.0, 5_411_870.0, 300.0])
    path = written(tmp_path / "a.las", POINTS + where, scales=np.full(3, 1e-3), offsets=where)
    frame = tofuse.open(path)[0]
    assert isinstance(frame, CloudFrame)
    np.testing.assert_array_equal(frame.shift, where)
    assert np.allclose(frame.points + frame.shift, POINTS + where, atol=2e-3)


@pytest.mark.parametrize("kind", ["WKT", "GeoTIFF"])
@pytest.mark.parametrize("unit", ["metre", "US survey foot"])
def test_las_in_feet_is_refused(tmp_path: Path, kind: str, unit: str) -> None:
    laspy = pytest.importorskip("laspy")
    system = f'PROJCS["x",GEOGCS["y",UNIT["degree",0.0174]],UNIT["{unit}",1.0]]'
    keys = struct.pack("<8H", 1, 1, 0, 1, 3076, 0, 1, 9001 if unit == "metre" else 9003)
    vlr = laspy.VLR("LASF_Projection", 34735, "", keys)
    if kind == "WKT":
        vlr = laspy.vlrs.known.WktCoordinateSystemVlr(system)
    path = written(tmp_path / "a.las", vlrs=[vlr])
    if unit == "metre":
        assert len(tofuse.open(path)[0]) == 500
        return
    says = r"a\.las: has coordinates in feet; convert .*to m by factor 0\.3048006096 \(`tofuse conv"
    refused(says, path)
    frame = tofuse.open(path, factor=0.3048006096)[0]
    np.testing.assert_allclose(frame.points, 0.3048006096 * POINTS, atol=0.01)
    target = np.array([0.1, 0, 0]) + frame.points
    found = tofuse.register(path, target, scale=0.3048006096, guess=np.eye(4))
    np.testing.assert_allclose(found.T_target_source[:3, 3], [0.1, 0, 0], atol=0.01)


def test_las_with_excessive_point_count(tmp_path: Path) -> None:
    pytest.importorskip("laspy")
    write_las(tmp_path / "a.las", GeometryRecord(POINTS))
    data = bytearray((tmp_path / "a.las").read_bytes())
    data[247:255] = struct.pack("<Q", 1 << 40)
    (tmp_path / "a.las").write_bytes(data)
    with pytest.raises(InputError, match="1099511627776 points don't fit into"):
        tofuse.open(tmp_path / "a.las")[0]


def test_las_with_wrong_bounds(tmp_path: Path) -> None:
    """The shift of its points is derived from the bounds in the header, which are wrong here."""
    path = written(tmp_path / "a.las")
    content = bytearray(path.read_bytes())
    content[179:227] = struct.pack("<6d", *[1e300] * 6)
    path.write_bytes(content)
    for item in tofuse.open(path).read_all():
        assert isinstance(item, InputError) or np.isfinite(item.points).all()


# In a LAZ file: the offset of the chunk table, or the number of chunks in it.
@pytest.mark.parametrize(
    ("where", "number"),
    [("table", 4), ("table", 1 << 60), ("table", -1), ("count", (1 << 32) - 1), ("count", 0)],
)
def test_forged_chunk_tables_of_laz_are_rejected(tmp_path: Path, where: str, number: int) -> None:
    """lazrs would allocate 64 GB for them, and abort the process if that fails."""
    laspy = pytest.importorskip("laspy")
    path = written(tmp_path / "a.laz")
    with laspy.open(path) as file:
        start = int(file.header.offset_to_point_data)
    content = bytearray(path.read_bytes())
    (table,) = struct.unpack_from("<q", content, start)
    if where == "table":
        struct.pack_into("<q", content, start, number)
    else:
        struct.pack_into("<I", content, table + 4, number)
    path.write_bytes(content)
    refused(r"a\.laz: chunk table: .*; copy the file again", path)


def test_laz_with_more_points_than_its_chunks(tmp_path: Path) -> None:
    path = written(tmp_path / "a.laz")
    content = bytearray(path.read_bytes())
    for count, message in (
        (60_000, "chunk table: 50000 points"),
        (90_000_000, "90000000 points don't fit"),
    ):
        struct.pack_into("<I", content, 107, count)
        path.write_bytes(content)
        refused(message, path)


def test_e57(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    path = tmp_path / "scans.e57"
    file = pye57.E57(str(path), mode="w")
    half = np.sqrt(0.5)
    for k in range(2):
        columns = {f"cartesian{a}": POINTS[:, i] + k for i, a in enumerate("XYZ")}
        columns |= {f"color{c}": RGB[:, i] for i, c in enumerate(("Red", "Green", "Blue"))}
        columns["intensity"] = np.linspace(0, 1, 500)
        file.write_scan_raw(
            columns,
            rotation=np.array([half, half * k, 0.0, 0.0] if k else [1.0, 0.0, 0.0, 0.0]),
            translation=np.array([1.0 * k, 0.0, 0.5]),
        )
    file.close()
    recording = tofuse.open(path)
    assert (recording.format, len(recording)) == ("e57", 2)
    frame = recording[1]
    assert isinstance(frame, CloudFrame)
    assert np.allclose(frame.points, POINTS + 1, atol=1e-5)  # in the scanner's own frame
    assert np.array_equal(frame.color, RGB)
    assert frame.amplitude[-1] == pytest.approx(1.0)
    reference = recording.reference
    assert np.allclose(reference[1][:3, :3], to_matrix(np.array([half, 0, 0, half])))
    assert np.allclose(reference[1][:3, 3], [1.0, 0.0, 0.5])
    # z of the map is up: y of the scan that was turned about x.
    assert np.allclose([recording[0].up, frame.up], [[0, 0, 1], [0, 1, 0]])

    (tmp_path / "more.e57").write_bytes(path.read_bytes())
    folder = tofuse.open(tmp_path)  # scanners write a file for each scan
    assert (folder.format, len(folder)) == ("e57", 4)


def test_e57_keeps_the_digits_of_map_coordinates(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    points = POINTS + np.array([500_000.0, 5_400_000.0, 300.0])
    sigma = np.linspace(0, 1, len(points), dtype=np.float32)
    write_e57(tmp_path / "a.e57", GeometryRecord(points, scalars={"sigma": sigma}))
    frame = tofuse.open(tmp_path / "a.e57")[0]
    np.testing.assert_allclose(frame.points + frame.shift, points, rtol=0, atol=1e-5)


def test_damaged_scans_are_refused_in_one_line(tmp_path: Path) -> None:
    pytest.importorskip("laspy")
    pytest.importorskip("pye57")
    for name, head in (("a.las", b"LASF"), ("b.e57", b"ASTM-E57")):
        (tmp_path / name).write_bytes(head + bytes(50))
        refused(name, tmp_path / name)


def test_ptx_states_poses_for_row_vectors(tmp_path: Path) -> None:
    """Several scans follow each other, and a zero is a direction without a measurement."""
    make_ptx(tmp_path / "scans")
    recording = tofuse.open(tmp_path / "scans")
    first, second, third = recording
    np.testing.assert_array_equal(first.points, [[k, k + 1, k + 2] for k in range(1, 6)])
    np.testing.assert_allclose(first.amplitude, [0.1, 0.2, 0.3, 0.4, 0.5])
    np.testing.assert_array_equal(second.color, [[10, 20, k] for k in range(6)])
    np.testing.assert_array_equal(third.points, first.points)
    T = [[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
    np.testing.assert_allclose(recording.reference, [T] * 3)
    np.testing.assert_allclose(first.up, [0, 0, 1])
