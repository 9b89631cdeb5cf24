"""Reading lenses from the calibration files of OpenCV and ROS.

Both have pixel coordinate 0 at the centre of the first pixel, as tofuse does.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofuse.engine.cameras import DISTORTION_ORDER, MODELS, Pinhole, pinhole_values
from tofuse.engine.errors import InputError
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading

_MAX_BYTES = 64 << 20
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_ROS_MODELS = {
    "plumb_bob": "brown",
    "rational_polynomial": "rational",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
# The names that programs give to the same field.
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "intrinsic_matrix")
_DISTORTION = (
    *("distortion_coefficients", "Distortion_Coefficients", "distortion_coeffs"),
    *("distCoeffs", "dist_coeffs", "D"),
)
_SIZE = ("image_size", "imageSize", "resolution")
_WIDTH = ("image_width", "image_Width", "imageWidth", "width")
_HEIGHT = ("image_height", "image_Height", "imageHeight", "height")


@dataclass(frozen=True, eq=False)
class LensFile:
    """The lens in a calibration file, and the file's format: "opencv" or "ros"."""

    camera: Pinhole
    format: str


def read_lens_file(path: str | Path, size: tuple[int, int] | None = None) -> LensFile:
    """Read a lens from a .yml, .yaml, .xml or .json of OpenCV, or a camera_info .yaml of ROS.

    Parameters
    ----------
    path
        The file.
    size
        Width and height of the images, if the file does not state them.

    Raises
    ------
    InputError
        If it is none of these, its values are invalid, or no model here describes the lens.
    """
    path = Path(path)
    text = reading.read_text(path, limit=_MAX_BYTES)
    matrix = _numbers(text, _MATRIX)
    if matrix is None or len(matrix) != 9:
        raise InputError(
            "contains no known lens (camera_matrix of OpenCV or ROS)",
            where=path,
            remedy="check the file",
        )
    stated = [*(_numbers(text, _WIDTH) or []), *(_numbers(text, _HEIGHT) or [])]
    stated = stated or _numbers(text, _SIZE) or list(size or ())
    if len(stated) != 2:
        raise InputError(
            "doesn't state the image size",
            where=path,
            remedy="add image_width and image_height, or pass --recording",
        )
    k = _numbers(text, _DISTORTION) or []
    ros_model = re.search(r"""distortion_model["']?\s*:\s*["']?(\w+)""", text)
    if ros_model is not None:
        model = _ROS_MODELS.get(ros_model[1].lower(), "")
        if not model:
            raise InputError(
                f"is {ros_model[1]!r:.40}",
                where=f"{path}: distortion_model",
                remedy=f"use one of {', '.join(_ROS_MODELS)}",
            )
    elif any(_numbers(text, ("fisheye_model",)) or []):
        model = "fisheye"
    else:
        model = "brown" if len(k) <= 5 else "rational"
    order = DISTORTION_ORDER[model]
    if any(k[len(order) :]):
        raise InputError(
            f"has {len(k)} distortion coefficients for a {model} lens",
            where=path,
            remedy=f"calibrate with {len(order)}, without thin prism or tilted sensor",
        )
    width, height = camera_file.image_size(stated[0], stated[1], f"{path}: image size")
    K = np.reshape(matrix, (3, 3))
    if K[2, :2].any() and not K[:2, 2].any():  # Open3D writes it column by column
        K = K.T
    values = pinhole_values(K, (height, width), f"{path}: camera_matrix")
    values |= dict(zip(order, k, strict=False))
    camera = camera_file.checked_lens(MODELS[model], (width, height), values, path)
    return LensFile(camera, "opencv" if ros_model is None else "ros")


def _numbers(text: str, names: tuple[str, ...]) -> list[float] | None:
    """Return the numbers of the first of these keys in YAML, JSON or XML; None if there is none."""
    for name in names:
        xml = re.search(rf"<{name}\b[^>]*>(.*?)</{name}>", text, re.DOTALL)
        # Everything after the key.
        yaml = re.search(rf"""(?:^|[{{,])\s*["']?{name}["']?\s*:(.*)""", text, re.M | re.DOTALL)
        if xml:
            data = re.search(r"<data>(.*?)</data>", xml[1], re.DOTALL)
            return [float(value) for value in re.findall(_NUMBER, data[1] if data else xml[1])]
        if yaml:
            body = yaml[1]
            if single := re.match(rf"\s*({_NUMBER})\b", body):
                return [float(single[1])]
            data = re.match(r"[^\[]{0,200}?[\"']?data[\"']?\s*:", body, re.DOTALL)
            body = body[data.end() :] if data else body
            flow = re.match(r"\s*(?:!!\S+\s*)?\[((?:[^\[\]]|\[[^\[\]]*\])*)\]", body)
            block = re.match(rf"\s*\n((?:\s*-\s*(?:-\s*)?{_NUMBER}\s*(?:\n|$))+)", body)
            if block:
                return [float(v) for v in re.findall(rf"-\s+({_NUMBER})\s*$", block[1], re.M)]
            return [float(v) for v in re.findall(_NUMBER, flow[1])] if flow else []
    return None
