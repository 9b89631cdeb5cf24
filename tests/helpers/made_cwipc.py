"""Folders of cwipc: cameras around a floor and two walls, in the formats of their recorders."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from made_kinect import BASELINE, DEPTH_LENS, make_mkv
from tofuse.geometry.se3 import inverse
from tofuse.lab.simulation.paths import rotation
from tofuse.recordings.readers.azure_kinect import DEPTH_MODES, KinectLens, depth_camera

# Planes n x = d of cwipc's world, y up: floor and two walls.
PLANES = (((0.0, 1.0, 0.0), 0.0), ((0.0, 0.0, 1.0), -1.5), ((1.0, 0.0, 0.0), -1.5))
SERIALS = ("000123102712", "000174202712")
T_COLOR_DEPTH = np.eye(4)
T_COLOR_DEPTH[:3, 3] = BASELINE


def looking(position: tuple[float, float, float], turn: float) -> np.ndarray:
    """T_world_camera of a camera that looks along -z and down, rotated about the vertical."""
    T = rotation([0.0, turn, 0.0]) @ rotation([-0.4, 0.0, 0.0]) @ rotation([np.pi, 0.0, 0.0])
    T[:3, 3] = position
    return T


TRAFOS = (looking((0.2, 1.3, 1.4), 0.1), looking((1.4, 1.2, 0.6), 0.9))
T_WORLD_DEPTH = tuple(T @ T_COLOR_DEPTH for T in TRAFOS)


def lens() -> KinectLens:
    """The depth camera of `made_kinect.DEPTH_LENS` in the smallest mode."""
    window = DEPTH_MODES["NFOV_2X2BINNED"]
    p = np.array(DEPTH_LENS)
    cx, cy = p[:2] * window.full_size - window.corner - 0.5
    fx, fy = p[2:4] * window.full_size
    k = {f"k{i}": float(p[3 + i]) for i in range(1, 7)}
    return KinectLens(*window.size, fx, fy, cx, cy, p1=p[13], p2=p[12], metric_radius=1.74, **k)


def depth_of(T_world_camera: np.ndarray) -> np.ndarray:
    """Depth in mm of the planes."""
    rays = depth_camera(lens()).rays().astype(float)
    directions = (
        np.concatenate([rays, np.ones((*rays.shape[:2], 1))], -1) @ T_world_camera[:3, :3].T
    )
    nearest = np.full(rays.shape[:2], np.inf)
    for normal, distance in PLANES:
        with np.errstate(all="ignore"):
            z = (distance - T_world_camera[:3, 3] @ normal) / (directions @ np.array(normal))
        nearest = np.where((z > 0.1) & (z < nearest), z, nearest)
    return np.where(np.isfinite(nearest), np.rint(1000 * nearest), 0).astype(np.uint16)


def config(version: int = 5, **changes: object) -> dict[str, object]:
    """The configuration that cwipc writes; `changes` replace its fields."""
    cameras = [
        {"disabled": False, "serial": serial, "trafo": T.tolist(), "type": "kinect_playback"}
        for serial, T in zip(SERIALS, TRAFOS, strict=True)
    ]
    data: dict[str, object] = {"camera": cameras, "type": "kinect_playback", "version": version}
    return data | {"system": {"record_to_directory": ""}} | changes


def make_cwipc(folder: Path, frames: int = 2) -> None:
    """Two stationary Azure Kinects."""
    folder.mkdir(parents=True, exist_ok=True)
    for serial, T in zip(SERIALS, T_WORLD_DEPTH, strict=True):
        make_mkv(folder / f"{serial}.mkv", np.stack([depth_of(T)] * frames))
    (folder / "cameraconfig.json").write_text(json.dumps(config()))


def off_planes(points: np.ndarray) -> np.ndarray:
    """Distance of points (N, 3) of the world from the nearest plane."""
    return np.min([np.abs(points @ np.array(n) - d) for n, d in PLANES], axis=0)


def expected_pose() -> np.ndarray:
    """T_rig_camera of the second camera."""
    return inverse(T_WORLD_DEPTH[0]) @ T_WORLD_DEPTH[1]
