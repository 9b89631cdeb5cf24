"""Small files of several formats, and ways to damage them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from made_recordings import CAMERA, pcd_bytes, pcd_points
from tofuse.engine.cameras.cameras import RayTable
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.sensor.camera_errors import DepthCorrection
from tofuse.formats.geometry.ply import write_ply
from tofuse.formats.recordings.native import RecordingWriter


def make_native(folder: Path) -> None:
    writer = RecordingWriter(folder, RayTable(CAMERA.rays()), confidence_max=7)
    for k in range(3):
        depth = np.full((30, 40), 1.0 + k, np.float32)
        images = {
            "amplitude_image": depth * 100,
            "confidence_image": np.full((30, 40), 7, np.uint8),
            "color_image": np.full((30, 40, 3), 50, np.uint8),
        }
        writer.add(RangeFrame(k, k / 10, CAMERA, depth, **images))  # type: ignore[arg-type]
    poses = np.tile(np.eye(4), (3, 1, 1))
    writer.finish(
        groundtruth=poses,
        odometry=poses,
        correction=DepthCorrection(np.array([1.0]), np.array([0.1])),
        imu={"t": np.arange(4.0)},
        frames={"temperature_c": np.arange(3.0)},
    )


def make_pcd(folder: Path) -> None:
    folder.mkdir()
    for k in range(2):
        (folder / f"{k}.pcd").write_bytes(pcd_bytes(pcd_points(CAMERA, k)))
    (folder / "poses.txt").write_text("0 0 0 0 1 0 0 0\n1 0 0 0 1 0 0 0\n")
    lines = "\n".join(f"{k} {k} {k}" for k in range(9))
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 9\nHEIGHT 1\nDATA ascii\n"
    (folder / "2.pcd").write_text(header + lines)


def make_ply(folder: Path) -> None:
    folder.mkdir()
    points = np.random.default_rng(1).normal(size=(30, 3))
    write_ply(folder / "0.ply", GeometryRecord(points, normals=points, faces=np.zeros((3, 3), int)))
    text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
    text += "property float z\nelement face 1\nproperty list uchar int vertex_index\nend_header\n"
    (folder / "1.ply").write_text(text + "0 0 0\n1 1 1\n3 0 1 1\n")
    (folder / "timestamps.txt").write_text("0\n1\n")
    (folder / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n")


def make_xyz(folder: Path) -> None:
    folder.mkdir()
    (folder / "0.xyz").write_text("1 2 3\n4 5 6\n")
    (folder / "1.xyz").write_text("1 2 3 4 5 6\n4 5 6 7 8 9\n")


def make_slam6d(folder: Path) -> None:
    folder.mkdir()
    for k in range(2):
        (folder / f"scan{k:03d}.3d").write_text("1 2 3\n4 5 6\n")
        (folder / f"scan{k:03d}.pose").write_text("1 2 3\n4 5 6\n")


def make_ptx(folder: Path) -> None:
    """Two scans in one file, of 2 x 3 points each, and one in another."""
    folder.mkdir()
    header = "2\n3\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n5 6 7 1\n"
    plain = header + "".join(f"{k} {k + 1} {k + 2} 0.{k}\n" for k in range(1, 6)) + "0 0 0 0.5\n"
    colors = header + "".join(f"{k} 2 3 0.5 10 20 {k}\n" for k in range(6))
    (folder / "a.ptx").write_text(plain + colors)
    (folder / "b.ptx").write_text(plain)


def damage(files: list[Path], rng: np.random.Generator) -> None:
    path = files[rng.integers(len(files))]
    data = bytearray(path.read_bytes())
    match int(rng.integers(7)):
        case 0:
            path.write_bytes(data[: rng.integers(len(data) + 1)])
        case 1:
            for at in rng.integers(0, max(1, len(data)), 1 + rng.integers(8)):
                if data:
                    data[at] ^= 1 << int(rng.integers(8))
            path.write_bytes(data)
        case 2:  # within the header
            for at in rng.integers(0, max(1, min(len(data), 300)), 3):
                if data:
                    data[at] = int(rng.integers(256))
            path.write_bytes(data)
        case 3:
            other = files[rng.integers(len(files))]
            swapped = other.read_bytes()
            other.write_bytes(data)
            path.write_bytes(swapped)
        case 4:
            path.unlink()
            path.mkdir()
        case 5:  # a digit of a text file is replaced
            digits = [k for k, c in enumerate(data[:2000]) if 48 <= c < 58]
            if digits:
                at = digits[rng.integers(len(digits))]
                words = (b"-1", b"nan", b"inf", b"1e999", b"99999999999", b"", b"x", b"\xff")
                data[at : at + 1] = words[rng.integers(len(words))]
            path.write_bytes(data)
        case _:
            path.unlink()
