"""A result as a data set of nerfstudio: images, depth, poses and points."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.apps.export.image_folder import (
    DEPTH,
    DEPTH_UNIT_M,
    IMAGES,
    MASKS,
    SIGMA,
    SIGMA_UNIT_M,
    subsampled_points,
    write_images,
)
from tofuse.engine.cameras import DISTORTION_ORDER, BrownConrady, Camera, Fisheye, Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.fusion import GeometryRecord
from tofuse.formats.files import atomic
from tofuse.formats.geometry import write_ply
from tofuse.formats.poses import OPENGL

_FILES = {"file_path": IMAGES, "depth_file_path": DEPTH, "sigma_file_path": SIGMA}


def write_nerfstudio(result: Path, folder: Path, every: int, pinhole: bool = False) -> None:
    """Write the main model of a result as a nerfstudio data set.

    Parameters
    ----------
    result
        The result.
    folder
        A new folder.
    every
        Every n-th of the frames with a pose.
    pinhole
        Whether to rectify all images.

    Raises
    ------
    InputError
        See `write_images`; or if only some have a fisheye lens.
    """
    supported = {Pinhole} if pinhole else set(_MODELS)
    images = write_images(result, folder, every, lambda camera: type(camera) in supported)
    lenses = [lens(posed.camera) for posed in images]
    frames: list[dict[str, Any]] = []
    for posed in images:
        frame: dict[str, Any] = {key: f"{kind}/{posed.name}" for key, kind in _FILES.items()}
        frame["transform_matrix"] = (posed.T_world_camera @ OPENGL).tolist()
        frame["timestamp"] = posed.timestamp
        if posed.covariance is not None:
            frame["pose_covariance"] = posed.covariance.ravel().tolist()
        frames.append(frame)
    header: dict[str, Any] = {"camera_model": lenses[0]["camera_model"]}
    if any(camera["camera_model"] != header["camera_model"] for camera in lenses):
        raise InputError(
            "mixes fisheye and other lenses, which this format does not support",
            where=result,
            remedy="export the results of the recordings one by one",
        )
    if all(camera == lenses[0] for camera in lenses):
        header = lenses[0]
    else:
        for frame, camera in zip(frames, lenses, strict=True):
            frame |= {key: value for key, value in camera.items() if key != "camera_model"}
    if any(posed.masked for posed in images):
        for frame in frames:
            frame["mask_path"] = f"{MASKS}/{Path(frame['file_path']).name}"
    header |= {
        "depth_unit_scale_factor": DEPTH_UNIT_M,
        "integer_depth_scale": DEPTH_UNIT_M,
        "sigma_unit_scale_factor": SIGMA_UNIT_M,
        "ply_file_path": "points.ply",
    }
    points, color = subsampled_points(result)
    write_ply(folder / "points.ply", GeometryRecord(points, color=color))
    header |= {"frames": []}
    text = json.dumps(header, indent=1, allow_nan=False).removesuffix("[]\n}")
    lines = ",\n  ".join(json.dumps(frame, allow_nan=False) for frame in frames)
    atomic.write_text(folder / "transforms.json", f"{text}[\n  {lines}\n ]\n}}\n")


_MODELS: dict[type[Camera], str] = {
    Pinhole: "OPENCV",
    BrownConrady: "OPENCV",
    Fisheye: "OPENCV_FISHEYE",
}


def lens(camera: Pinhole) -> dict[str, Any]:
    """Return a camera as in `transforms.json`, where (0, 0) is the corner of the first pixel."""
    order = DISTORTION_ORDER[camera.model]
    return {
        "camera_model": _MODELS[type(camera)],
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(camera.fx),
        "fl_y": float(camera.fy),
        "cx": float(camera.cx + 0.5),
        "cy": float(camera.cy + 0.5),
    } | {name: float(np.float64(getattr(camera, name))) for name in order}
