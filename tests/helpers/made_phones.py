"""Small recordings of phones, in the layouts of their apps."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from tofuse.engine.geometry.quaternion import from_matrix
from tofuse.engine.geometry.se3 import exp, inverse
from tofuse.formats.images.images import write_png

WIDTH, HEIGHT = 32, 24  # with the aspect ratio of 1920 x 1440
FX, CX, CY = 1300.0, 961.5, 718.25
RNG = np.random.default_rng(50)
DEPTH = RNG.uniform(0.4, 4.0, (3, HEIGHT, WIDTH)).astype(np.float32)
DEPTH[:, 0, 0] = 0
CONFIDENCE = RNG.integers(0, 3, (3, HEIGHT, WIDTH), np.uint8)
POSES = exp(RNG.normal(size=(3, 6)) * 0.5)
ARKIT = np.diag([1.0, -1.0, -1.0, 1.0])


def millimetres(depth: np.ndarray) -> np.ndarray:
    return np.rint(depth * 1000).astype(np.uint16)


def color_image(k: int, width: int = 8 * WIDTH, height: int = 8 * HEIGHT) -> np.ndarray:
    """Left half red by k, right half blue: rotation and mirroring are visible."""
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 2, 0] = 100 + 40 * k
    image[:, width // 2 :, 2] = 200
    return image


def jpeg(image: np.ndarray) -> bytes:
    ok, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])
    assert ok
    return bytes(data)


def projection(focal_length: float) -> np.ndarray:
    return np.diag([2 * focal_length / 1920, 2 * focal_length / 1440, -1, 0])


def make_scanner_app(folder: Path) -> None:
    folder.mkdir(parents=True)
    for k in range(3):
        write_png(folder / f"depth_{k:05d}.png", millimetres(DEPTH[k]))
        write_png(folder / f"conf_{k:05d}.png", CONFIDENCE[k])
        facts = {
            "time": 1000.5 + 0.2 * k,
            "intrinsics": [FX + k, 0, CX, 0, FX + k, CY, 0, 0, 1],
            "cameraPoseARFrame": (POSES[k] @ ARKIT).ravel().tolist(),
            "projectionMatrix": projection(FX + k).ravel().tolist(),
        }
        (folder / f"frame_{k:05d}.json").write_text(json.dumps(facts))
    (folder / "frame_00001.jpg").write_bytes(jpeg(color_image(1)))
    (folder / "info.json").write_text("{}")


def make_stray(folder: Path, *, lenses: bool = False) -> None:
    for name in ("depth", "confidence"):
        (folder / name).mkdir(parents=True)
    extra = ", fx, fy, cx, cy" if lenses else ""
    lines = [f"timestamp, frame, x, y, z, qx, qy, qz, qw{extra}"]
    for k in range(3):
        write_png(folder / "depth" / f"{k:06d}.png", millimetres(DEPTH[k]))
        write_png(folder / "confidence" / f"{k:06d}.png", CONFIDENCE[k])
        row = [100 + k / 60, *POSES[k, :3, 3], *from_matrix(POSES[k, :3, :3])]
        cells = [f"{row[0]!r}", f"{k:06d}", *(repr(float(v)) for v in row[1:])]
        cells += [str(FX + k), str(FX + k), str(CX), str(CY)] if lenses else []
        lines.append(", ".join(cells))
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    (folder / "camera_matrix.csv").write_text(f"{FX}, 0, {CX}\n0, {FX}, {CY}\n0, 0, 1\n")
    (folder / "imu.csv").write_text(
        "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n1, 0, -9.8, 0, 0, 0, 0.5\n"
    )


def make_arkitscenes(folder: Path) -> None:
    """With the file of one lens named a millisecond later, as it occurs in the data set."""
    for name in ("lowres_depth", "lowres_wide", "lowres_wide_intrinsics", "confidence"):
        (folder / name).mkdir(parents=True)
    lines = []
    for k in range(3):
        name = f"41048190_{3418.328 + k / 10:.3f}"
        write_png(folder / "lowres_depth" / f"{name}.png", millimetres(DEPTH[k]))
        write_png(folder / "confidence" / f"{name}.png", CONFIDENCE[k])
        write_png(folder / "lowres_wide" / f"{name}.png", color_image(k, WIDTH, HEIGHT))
        lens = (
            folder / "lowres_wide_intrinsics" / f"41048190_{3418.328 + k / 10 + k // 2 / 1e3:.3f}"
        )
        numbers = [(FX + k) / 60, (FX + k) / 60, (CX + 0.5) / 60 - 0.5, (CY + 0.5) / 60 - 0.5]
        text = " ".join(map(str, (WIDTH, HEIGHT, *numbers)))
        lens.with_name(f"{lens.name}.pincam").write_text(text)
        T_camera_world = inverse(POSES[k])
        turn = cv2.Rodrigues(T_camera_world[:3, :3])[0].ravel()
        row = [3418.33 + k / 10, *turn.tolist(), *T_camera_world[:3, 3].tolist()]
        lines.append(" ".join(map(repr, row)))
    (folder / "lowres_wide.traj").write_text("\n".join(lines) + "\n")


def exr_bytes(
    image: np.ndarray, compression: int = 3, kind: int = 1, name: str = "R", lines: int = 16
) -> bytes:
    """Write a grey OpenEXR image in the published layout."""

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<I", len(value)) + value

    height, width = image.shape
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channel = name.encode() + b"\0" + struct.pack("<IIII", kind, 0, 1, 1) + b"\0"
    data = b"\x76\x2f\x31\x01" + struct.pack("<I", 2)
    data += attribute("channels", "chlist", channel)
    data += attribute("compression", "compression", bytes([compression]))
    data += attribute("dataWindow", "box2i", box) + attribute("displayWindow", "box2i", box)
    data += attribute("lineOrder", "lineOrder", b"\0")
    data += attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    data += attribute("screenWindowCenter", "v2f", bytes(8))
    data += attribute("screenWindowWidth", "float", struct.pack("<f", 1)) + b"\0"
    values = image.astype(["<u4", "<f2", "<f4"][kind])
    blocks = []
    for y in range(0, height, lines):
        raw = values[y : y + lines].tobytes()
        if compression:
            shuffled = raw[0::2] + raw[1::2]
            steps = [shuffled[0]] + [(b - a + 128) % 256 for a, b in pairwise(shuffled)]
            packed = zlib.compress(bytes(steps))
            raw = packed if len(packed) < len(raw) else raw
        blocks.append(struct.pack("<iI", y, len(raw)) + raw)
    at = len(data) + 8 * len(blocks)
    for block in blocks:
        data += struct.pack("<Q", at)
        at += len(block)
    return data + b"".join(blocks)


def record3d_metadata() -> dict[str, object]:
    """Portrait: the images are rotated, 1440 x 1920 and 24 x 32."""
    poses = POSES @ ARKIT
    rows = np.concatenate([from_matrix(poses[:, :3, :3]), poses[:, :3, 3]], 1).tolist()
    about = {"w": 1440, "h": 1920, "dw": HEIGHT, "dh": WIDTH, "fps": 60}
    about |= {"K": [FX, 0, 0, 0, FX, 0, CY, CX, 1], "frameTimestamps": [k / 60 for k in range(5)]}
    return about | {"poses": [rows[k % 3] for k in range(5)]}


def make_record3d(folder: Path) -> None:
    for name in ("depth", "rgb"):
        (folder / name).mkdir(parents=True)
    for k in range(3):
        depth = np.ascontiguousarray(DEPTH[k].T)
        (folder / "depth" / f"{k}.exr").write_bytes(exr_bytes(depth))
        (folder / "rgb" / f"{k}.jpg").write_bytes(jpeg(color_image(k, 8 * HEIGHT, 8 * WIDTH)))
    (folder / "metadata.json").write_text(json.dumps(record3d_metadata()))


def lzfse_raw(data: bytes) -> bytes:
    """An LZFSE stream of one uncompressed block."""
    return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"


def make_r3d(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(record3d_metadata()))
        for k in range(3):
            depth = np.ascontiguousarray(DEPTH[k].T).astype("<f4")
            archive.writestr(f"rgbd/{k}.depth", lzfse_raw(depth.tobytes()))
            archive.writestr(f"rgbd/{k}.conf", lzfse_raw(CONFIDENCE[k].T.tobytes()))
            archive.writestr(f"rgbd/{k}.jpg", jpeg(color_image(k, 8 * HEIGHT, 8 * WIDTH)))
