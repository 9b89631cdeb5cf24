"""A result with posed images of a plane."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofuse.engine.cameras.cameras import BrownConrady, Camera
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.formats.geometry.ply import write_ply
from tofuse.formats.poses.trajectory import write_tum
from tofuse.formats.recordings.open import Opening
from written import record
from written_run_json import write_run

SIZE = (48, 36)


BROWN = BrownConrady(*SIZE, 40.0, 41.0, 23.0, 18.0, k1=-0.1, k2=0.02, p1=0.002, p2=-0.001)


NORMAL, DISTANCE = np.array([0.1, -0.2, 0.97]), 1.7


POSES = se3.exp(np.random.default_rng(4).normal(size=(5, 6)) * 0.3)


POSES[0] = np.eye(4)


POSED = [0, 1, 3, 4]  # frame 2 is lost


def plane(camera: Camera, k: int) -> np.ndarray:
    """z (H, W) of a plane, a little further away in each frame; invalid in a corner."""
    z = (DISTANCE + 0.1 * k) / (camera.rays().astype(float) @ NORMAL[:2] + NORMAL[2])
    z[:4, :4] = 0
    return np.round(np.nan_to_num(z, nan=0.0), 3).astype(np.float32)


def made_result(folder: Path, camera: Camera, *, config=None) -> Path:
    """A recording of five frames, and a result with the poses of four of them."""
    frames = []
    for k in range(5):
        z = plane(camera, k)
        image = np.zeros((*z.shape, 3), np.uint8)
        image[..., 0], image[..., 1], image[..., 2] = 10 + k, np.arange(48), 200
        frames.append(RangeFrame(k, 0.1 * k, camera, z, color_image=image))
    recording = record(folder / "scan", frames)
    result = folder / "result"
    result.mkdir()
    frames = [{"index": k, "timestamp": 0.1 * k} for k in range(5)]
    for k, frame in enumerate(frames):
        seen = {"status": "tracked", "component": 0} if k in POSED else {"status": "lost"}
        frame |= seen | {"covariance": None if k == 1 else (np.eye(6) * k).ravel().tolist()}
    write_tum(result / "trajectory.txt", 0.1 * np.array(POSED), POSES[POSED])
    points = np.random.default_rng(5).normal(size=(40, 3)).astype(np.float32)
    write_ply(result / "cloud.ply", GeometryRecord(points, color=np.full((40, 3), 77, np.uint8)))
    write_run(
        result,
        frames=frames,
        config=config or {"corrections": []},
        components=[{"frames": [[0, 4]], "T_main_component": np.eye(4).tolist(), "joined": None}],
        input={"path": str(recording), "opening": Opening((recording,)).to_dict()},
    )
    return result
