"""Exports of ToF viewers: organised clouds, TIFF images; and unsupported files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import made_exports as made
from made_exports import BEHIND_M, CAMERA
from refused import refused
from tofuse.engine.cameras.cameras import BrownConrady
from tofuse.engine.errors import InputError
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.formats.geometry.ply import read_ply, write_ply
from tofuse.formats.images.images import read_tiff
from tofuse.formats.recordings.open import open_recording
from written import camera_json

Maker = Callable[[Path], None]
MAKERS: dict[str, tuple[Maker, float]] = {
    "helios": (made.make_helios, 3e-4),
    "blaze": (made.make_blaze, 1e-5),
    "csv": (made.make_csv, 1e-5),
    "csv-bare": (lambda folder: made.make_csv(folder, head=""), 1e-5),
    "royale": (made.make_royale, 2e-5),
}


@pytest.mark.parametrize("name", MAKERS)
def test_organised_clouds_become_images(tmp_path: Path, name: str) -> None:
    make, off = MAKERS[name]
    make(tmp_path / "a")
    recording = open_recording(tmp_path / "a")
    assert recording.format == "grid"
    z = made.depths()
    for k in (2, 0):
        frame = recording[k]
        np.testing.assert_array_equal(frame.valid, z[k] > 0)
        np.testing.assert_allclose(frame.points, made.points(z)[k][z[k] > 0], atol=off)
        if name == "royale":
            assert frame.amplitude_image is None
        else:
            np.testing.assert_array_equal(frame.amplitude_image, made.amplitudes()[k])
    moved = [line for line in recording.warnings if "in front of the camera" in line]
    assert len(moved) == (name == "helios")
    if moved:
        stated = float(moved[0].split(" mm ")[0].rsplit(" ", 1)[1])
        assert stated == pytest.approx(1000 * BEHIND_M, abs=0.2)


@pytest.mark.parametrize("signs", [(-1, -1, 1), (1, -1, -1), (1, -1, 1)])
def test_reversed_axes_are_corrected(tmp_path: Path, signs: tuple[int, int, int]) -> None:
    made.make_royale(tmp_path / "a")
    for file in (tmp_path / "a").iterdir():
        write_ply(file, GeometryRecord(read_ply(file).points * np.array(signs, np.float32)))
    recording = open_recording(tmp_path / "a")
    assert any("against the pixels" in line for line in recording.warnings)
    z = made.depths()
    np.testing.assert_allclose(recording[1].points, made.points(z)[1][z[1] > 0], atol=2e-5)


def test_other_clouds_stay_clouds(tmp_path: Path) -> None:
    """Random points, and a height field, whose rows and columns are not pixels of a camera."""
    rng = np.random.default_rng(310)
    y, x = np.mgrid[:24, :32] / 10
    field = np.stack([x - 1.6, y - 1.2, 2 + rng.uniform(-1, 1, x.shape)], -1)
    for k, points in enumerate((rng.normal(size=(768, 3)), field.reshape(-1, 3))):
        folder = tmp_path / str(k)
        folder.mkdir()
        write_ply(folder / "0.ply", GeometryRecord(points))
        recording = open_recording(folder)
        assert recording.format == "ply"
        assert isinstance(recording[0], CloudFrame)
        refused(r"one point per pixel .*format ply", folder, format="grid")


def test_missing_points_leave_others_on_their_pixels(tmp_path: Path) -> None:
    for name in ("whole", "thinned"):
        made.make_helios(tmp_path / name)
    path = tmp_path / "thinned" / "Image_1.ply"
    ply = read_ply(path)
    kept = ply.points[:, 2] > 0
    assert not kept.all()
    write_ply(path, GeometryRecord(ply.points[kept], scalars={"intensity": ply.amplitude[kept]}))
    whole, thinned = (open_recording(tmp_path / name)[1] for name in ("whole", "thinned"))
    both = (whole.depth > 0) & (thinned.depth > 0)
    # Pixels without depth in the first file have no ray.
    assert both.sum() > 0.8 * (whole.depth > 0).sum() >= 0.8 * (thinned.depth > 0).sum()
    np.testing.assert_allclose(thinned.depth[both], whole.depth[both], rtol=1e-3)
    np.testing.assert_array_equal(thinned.amplitude_image[both], whole.amplitude_image[both])


def camera_of(folder: Path, lens: BrownConrady = CAMERA, **changes: object) -> Path:
    bent = {"model": "brown", "distortion": [lens.k1, lens.k2, lens.p1, 0.0]}
    return camera_json(folder / "camera.json", lens, **(bent | {"depth_kind": "range"} | changes))


def test_tiff3d_with_camera(tmp_path: Path) -> None:
    made.make_tiff3d(tmp_path / "a")
    refused(r"has no camera: the layout of \.t3c .* use camera=camera\.json", tmp_path / "a")
    camera = camera_of(tmp_path, frame_rate_hz=25.0, ambiguity_m=7.5)
    recording = open_recording(tmp_path / "a", camera=camera)
    assert recording.format == "tiff"
    np.testing.assert_allclose(recording.timestamps, [0, 0.04, 0.08])
    z = made.depths()
    for k, frame in enumerate(recording):
        assert (frame.depth_kind, frame.ambiguity_m) == ("range", 7.5)
        np.testing.assert_allclose(frame.points, made.points(z)[k][z[k] > 0], atol=1e-5)
        np.testing.assert_array_equal(frame.amplitude_image, made.amplitudes()[k])


def test_other_tiffs_are_depth_on_request(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    folder.mkdir()
    counts = (made.depths()[0] / 1e-4).astype(np.uint16)
    counts[0, 0] = 65535
    cv2.imwrite(str(folder / "depth_1.tiff"), counts)
    cv2.imwrite(str(folder / "confidence_1.tiff"), counts)
    refused(r"use format tiff and camera=camera\.json", folder)
    camera = camera_of(tmp_path, depth_unit_m=1e-4, depth_kind="z")
    frame = open_recording(folder, format="tiff", camera=camera)[0]
    assert frame.amplitude_image is None
    counts[0, 0] = 0
    np.testing.assert_allclose(frame.z, counts * 1e-4, rtol=1e-6)
    small = camera_of(tmp_path, width=16, height=12)
    refused("32 x 24 pixels, the camera 16 x 12", folder, format="tiff", camera=small)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("kind", ["u2", "f4"])
def test_tiffs_of_either_byte_order(tmp_path: Path, order: str, kind: str) -> None:
    """They give the same values; a turned or mirrored image is refused."""
    image = made.depths()[0].astype(kind)
    for orientation in (1, 2, 3):
        path = tmp_path / "a.tif"
        path.write_bytes(made.tiff(image, order, orientation))
        if orientation == 1:
            np.testing.assert_array_equal(read_tiff(path), image)
            continue
        refused("turned or mirrored by its tag Orientation", path, by=read_tiff)


def test_damaged_tiffs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    cv2.imwrite(str(path), np.zeros((24, 32, 3), np.uint8))
    refused("3 channels", path, by=read_tiff)
    cv2.imwrite(str(path), np.arange(768, dtype=np.uint16).reshape(24, 32) % 251)
    data = path.read_bytes()
    for content, problem in (
        (b"", "is empty"),
        (b"II*\0\xff\xff\xff\xff", "damaged"),
        (data.replace(b"\0\1\3\0\1\0\0\0\x20\0", b"\0\1\4\0\1\0\0\0\xff\xff"), r"\w"),
        (data[:60], "damaged|cut off"),
    ):
        path.write_bytes(content)
        refused(problem, path, by=read_tiff)


@pytest.mark.parametrize("inside", [False, True])
def test_proprietary_format_is_refused_with_remedy(tmp_path: Path, inside: bool) -> None:
    path = tmp_path / "a" / "b.rrf"
    path.parent.mkdir()
    path.write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match=r"raw phases of a pmd camera.*sampleExportPLY") as found:
        open_recording(path.parent if inside else path)
    assert len(str(found.value).splitlines()) == 1
