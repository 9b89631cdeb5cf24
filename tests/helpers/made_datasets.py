"""Views from within a box of known size, in the layouts of data sets."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ray_casting import rays_at, to_walls
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.geometry.se3 import exp
from tofuse.formats.images.images import write_png
from written import camera_json

CAMERA = Pinhole(64, 48, 60.0, 62.0, 31.0, 24.5)
SIDES = np.array([2.0, 1.5, 2.5])  # half of the edges of the box, m
POSES = exp(np.random.default_rng(70).normal(size=(3, 6)) * [0.3, 0.3, 0.3, 0.4, 0.4, 0.4])


def depths() -> np.ndarray:
    """(N, H, W) z in m of the box around the origin, seen from `POSES`."""
    return np.stack([to_walls(*rays_at(T, CAMERA), -SIDES, SIDES)[0] for T in POSES])


def color(k: int) -> np.ndarray:
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    image[:, :20] = 80 * k + 40
    return image


def write_images(depth: Path, image: Path, counts: np.ndarray, k: int) -> None:
    for path in (depth, image):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_png(depth, counts)
    write_png(image, color(k))


def make_sun3d(folder: Path) -> None:
    """Twice as many images as depth, each with a pose of T_world_camera in three rows."""
    for k, z in enumerate(depths()):
        mm = np.rint(1000 * z).astype(np.uint16)
        name = f"{k + 1:07d}-{k * 66_000:012d}.png"
        image = folder / "image" / f"{2 * k + 1:07d}-{k * 66_000 + 3000:012d}.png"
        write_images(folder / "depth" / name, image, (mm << 3) | (mm >> 13), k)
        other = f"{2 * k + 2:07d}-{k * 66_000 + 36_000:012d}.png"
        write_png(folder / "image" / other, color(0))
    lens = f"{CAMERA.fx} 0 {CAMERA.cx}\n0 {CAMERA.fy} {CAMERA.cy}\n0 0 1\n"
    (folder / "intrinsics.txt").write_text(lens)
    (folder / "extrinsics").mkdir()
    (folder / "extrinsics" / "20130512130736.txt").write_text("an earlier version\n")
    poses = np.repeat(POSES[:, :3], 2, axis=0)
    np.savetxt(folder / "extrinsics" / "20140808220511.txt", poses.reshape(-1, 4))


def make_bop(folder: Path) -> None:
    """Images 0, 3 and 6 of a scene, in tenths of a millimetre."""
    cameras = {}
    for k, (z, T) in enumerate(zip(depths(), np.linalg.inv(POSES), strict=True)):
        name = f"{3 * k:06d}.png"
        counts = np.rint(10_000 * z).astype(np.uint16)
        write_images(folder / "depth" / name, folder / "rgb" / name, counts, k)
        cameras[str(3 * k)] = {
            "cam_K": [CAMERA.fx, 0.0, CAMERA.cx, 0.0, CAMERA.fy, CAMERA.cy, 0.0, 0.0, 1.0],
            "depth_scale": 0.1,
            "cam_R_w2c": T[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1000 * T[:3, 3]).tolist(),
        }
    (folder / "scene_camera.json").write_text(json.dumps(cameras))


def make_replica(folder: Path, parameters: str = "cam_params.json") -> None:
    """With the file of the camera beside the images, or above."""
    for k, z in enumerate(depths()):
        names = [folder / "results" / f"{name}{k:06d}.png" for name in ("depth", "frame")]
        write_images(*names, np.rint(6553.5 * z).astype(np.uint16), k)
    np.savetxt(folder / "traj.txt", POSES.reshape(-1, 16))
    lens = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy")}
    about = {"camera": {"w": CAMERA.width, "h": CAMERA.height, "scale": 6553.5, **lens}}
    (folder / parameters).write_text(json.dumps(about))


def make_pairs(
    folder: Path, depth: str = "{:05d}-depth.png", image: str = "{:05d}-color.png"
) -> None:
    """With a camera.json, which states a unit of 0.1 mm."""
    for k, z in enumerate(depths()):
        counts = np.rint(10_000 * z).astype(np.uint16)
        write_images(folder / depth.format(k), folder / image.format(k), counts, k)
    camera_json(folder / "camera.json", CAMERA, depth_unit_m=1e-4)
