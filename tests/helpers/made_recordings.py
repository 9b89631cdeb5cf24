"""Small recordings in other formats, with known ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.geometry.se3 import exp
from tofuse.formats.images.images import write_png
from tofuse.formats.poses.trajectory import write_tum

RNG = np.random.default_rng(20)
COUNTS = [RNG.integers(500, 4000, (480, 640), np.uint16) for _ in range(3)]
for _counts in COUNTS:
    _counts[0, 0], _counts[0, 1] = 0, 65535
POSES = exp(RNG.normal(size=(3, 6)))


def sr4000_text(z: np.ndarray, rays: np.ndarray, behind: float, time_ms: float) -> str:
    """Write an export whose rays intersect `behind` metres behind the origin, x left and y up."""
    x, y = (-rays[..., k] * (z + behind) for k in (0, 1))
    confidence = np.full(z.shape, 5)
    amplitude = np.arange(z.size).reshape(z.shape)
    blocks = {
        "Calibrated Distance": (z, "%.4f"),
        "Calibrated xVector": (x, "%.4f"),
        "Calibrated yVector": (y, "%.4f"),
        "Amplitude": (amplitude, "%d"),
        "Confidence map": (confidence, "%d"),
    }
    text = ""
    for title, (block, style) in blocks.items():
        rows = ["\t".join(style % v for v in row) for row in block]
        text += f"% {title}\n" + "\n".join(rows) + "\n"
    tail = [f"{time_ms:g}", *["nan"] * (z.shape[1] - 1)]
    return text + "% additional data / time stamp [ms]\n" + "\t".join(tail) + "\n"


def make_sr4000(folder: Path, count: int = 3) -> tuple[np.ndarray, np.ndarray]:
    folder.mkdir(parents=True)
    v, u = np.mgrid[:12, :16]
    rays = np.stack([(u - 7.5) / 20, (v - 5.5) / 20], -1)
    z = np.random.default_rng(21).uniform(0.3, 4.9, (count, 12, 16)).round(4)
    z[:, 3, 3] = 0.004
    for k in range(count):
        (folder / f"frm_{k + 1:04d}.dat").write_text(sr4000_text(z[k], rays, 0.01, 31.25 * k))
    return z, rays


def make_tum(folder: Path) -> None:
    for name in ("depth", "rgb"):
        (folder / name).mkdir(parents=True)
    depth_lines, color_lines = ["# timestamp filename"], ["# timestamp filename"]
    for k, counts in enumerate(COUNTS):
        time = 1305031102.16 + k / 30
        write_png(folder / "depth" / f"{time:.6f}.png", counts)
        write_png(folder / "rgb" / f"{time:.6f}.png", np.full((480, 640, 3), k, np.uint8))
        depth_lines.append(f"{time:.6f} depth/{time:.6f}.png")
        color_lines.insert(1, f"{time + 0.012:.6f} rgb/{time:.6f}.png")
    (folder / "depth.txt").write_text("\n".join(depth_lines) + "\n")
    (folder / "rgb.txt").write_text("\n".join(color_lines) + "\n")
    write_tum(folder / "groundtruth.txt", 1305031102.15 + np.arange(3) / 30, POSES)


def make_7scenes(folder: Path) -> None:
    folder.mkdir(parents=True)
    for k, counts in enumerate(COUNTS):
        stem = folder / f"frame-{2 * k:06d}"
        write_png(stem.with_name(stem.name + ".depth.png"), counts)
        np.savetxt(stem.with_name(stem.name + ".pose.txt"), POSES[k])
        write_png(stem.with_name(stem.name + ".color.png"), np.full((480, 640, 3), k, np.uint8))


BUNDLEFUSION_INFO = """m_versionNumber = 4
m_sensorName = StructureSensor
m_colorWidth = 320
m_colorHeight = 240
m_depthWidth = 640
m_depthHeight = 480
m_depthShift = 5000
m_calibrationColorIntrinsic = 290 0 160 0 0 290 120 0 0 0 1 0 0 0 0 1
m_calibrationColorExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
m_calibrationDepthIntrinsic = 583 0 320 0 0 584 240 0 0 0 1 0 0 0 0 1
m_calibrationDepthExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
m_frames.size = 3
"""


def make_bundlefusion(folder: Path) -> None:
    make_7scenes(folder)
    (folder / "info.txt").write_text(BUNDLEFUSION_INFO)


def make_redwood(folder: Path, color: str = "color") -> None:
    for name in ("depth", color):
        (folder / name).mkdir(parents=True)
    lines = []
    for k, counts in enumerate(COUNTS):
        write_png(folder / "depth" / f"{k + 1:06d}-{k * 33369:012d}.png", counts)
        write_png(folder / color / f"{k + 1:06d}.png", np.full((480, 640, 3), k, np.uint8))
        lines += [f"{k} {k} {k + 1}", *(" ".join(map(repr, row)) for row in POSES[k].tolist())]
    (folder / "trajectory.log").write_text("\n".join(lines) + "\n")


def pcd_bytes(points: np.ndarray, **columns: np.ndarray) -> bytes:
    """Write an organised binary PCD of (H, W, 3) points."""
    height, width = points.shape[:2]
    names, sizes = ["x", "y", "z", *columns], " ".join(["4"] * (3 + len(columns)))
    parts = [points.astype("<f4")]
    parts += [np.asarray(c, "<f4").reshape(height, width, 1) for c in columns.values()]
    header = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {' '.join(names)}\nSIZE {sizes}\n"
        f"TYPE {' '.join(['F'] * len(names))}\nCOUNT {' '.join(['1'] * len(names))}\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {width * height}\n"
        "DATA binary\n"
    )
    return header.encode() + np.concatenate(parts, -1).astype("<f4").tobytes()


CAMERA = Pinhole(40, 30, 35.0, 36.0, 19.5, 14.5)


def pcd_points(camera: Pinhole, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.5, 4, (camera.height, camera.width, 1))
    points = np.concatenate([camera.rays() * z, z], -1)
    points[rng.uniform(size=points.shape[:2]) < 0.3] = np.nan
    return points
