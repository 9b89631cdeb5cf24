"""Reading lenses from the calibration files of other programs.

All of these have pixel coordinate 0 at the centre of the first pixel, as tofuse does: Bouguet's
toolbox subtracts 1 from MATLAB's coordinates before calibration, OpenCV and ROS use this origin,
and a CalLab file states its origin. A lens that none of the models here describes (skew, thin
prism, tilted sensor) is converted to a table of rays, exactly.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.files.reading import read_bytes, read_text
from tofuse.geometry.cameras import DISTORTION_ORDER, MODELS, Camera, Pinhole, RayTable
from tofuse.recordings.camera_file import MAX_SKEW_PX, checked_lens

_MAX_BYTES = 64 << 20
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?"
_MATLAB = ("fc", "cc", "alpha_c", "kc", "nx", "ny")
_CALLAB = ("A", "k1", "k2", "k3", "p1", "p2", "width", "height")
_ROS_MODELS = {
    "plumb_bob": "brown",
    "rational_polynomial": "rational",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}


@dataclass(frozen=True, eq=False)
class LensFile:
    """The content of a calibration file.

    Attributes
    ----------
    camera
        The lens.
    format
        "bouguet", "callab", "opencv" or "ros".
    warnings
        For the user, one line each.
    """

    camera: Camera
    format: str
    warnings: tuple[str, ...] = ()


def read_lens_file(path: str | Path, index: int | None = None) -> LensFile:
    """Read a lens from a calibration file, whose format is detected by its content.

    Parameters
    ----------
    path
        Calib_Results.m or .mat of Bouguet's toolbox, a .cal of DLR CalLab, a .yml, .yaml, .xml or
        .json of OpenCV, or a camera_info .yaml of ROS.
    index
        Index of the camera, if a CalLab file contains several.

    Raises
    ------
    InputError
        If it is none of these, or its values are invalid.
    """
    path = Path(path)
    if path.suffix.lower() == ".mat":
        return _bouguet(_mat_values(path), path)
    text = read_text(path, limit=_MAX_BYTES)
    if re.search(r"^\s*camera\.(\d+\.)?A\s*=", text, re.MULTILINE):
        return _callab(text, index, path)
    if re.search(r"^\s*fc\s*=", text, re.MULTILINE):
        return _bouguet(_m_values(text), path)
    return _opencv(text, path)


def _m_values(text: str) -> dict[str, list[float]]:
    """Return the numbers that a MATLAB script assigns, without running it."""
    plain = re.sub(r"%.*", "", text)
    out = {}
    for name in _MATLAB:
        match = re.search(rf"^\s*{name}\s*=\s*(\[[^\]]*\]|{_NUMBER})", plain, re.MULTILINE)
        if match:
            out[name] = _numbers(match[1])
    return out


def _mat_values(path: Path) -> dict[str, list[float]]:
    from scipy.io import loadmat

    read_bytes(path, limit=_MAX_BYTES)
    try:
        data = loadmat(str(path), variable_names=_MATLAB)
        return {n: np.asarray(data[n], float).ravel().tolist() for n in _MATLAB if n in data}
    except Exception as error:  # a parser of a binary format may raise anything
        raise InputError(
            f"can't be read as a .mat file ({error})",
            where=path,
            remedy="save it by the toolbox again, with -v7 or older, or pass Calib_Results.m",
        ) from error


def _bouguet(values: dict[str, list[float]], path: Path) -> LensFile:
    for name, count in (("fc", 2), ("cc", 2), ("nx", 1), ("ny", 1)):
        if len(values.get(name, [])) != count:
            raise InputError(
                f"has no {name}", where=path, remedy="save the results of the toolbox again"
            )
    k = values.get("kc", [])
    if len(k) > 5:
        raise InputError(
            f"has {len(k)} distortion coefficients",
            where=f"{path}: kc",
            remedy="pass the results of a perspective lens, [k1 k2 p1 p2 k3]",
        )
    skew = (values.get("alpha_c") or [0.0])[0] * values["fc"][0]
    size = _size(values["nx"][0], values["ny"][0], path)
    camera, warnings = _lens("brown", [*values["fc"], *values["cc"]], skew, k, size, path)
    return LensFile(camera, "bouguet", warnings)


def _callab(text: str, index: int | None, path: Path) -> LensFile:
    """Read version 2, whose files document the format in their comments."""
    plain = re.sub(r"#.*", "", text)
    pairs: dict[str, str] = {
        key: value.strip() for key, value in re.findall(r"^\s*([\w.]+)\s*=(.*)$", plain, re.M)
    }
    if pairs.get("version") != "2":
        raise InputError(
            f"is version {pairs.get('version', 'unknown'):.20}",
            where=path,
            remedy="write it by a CalLab whose files say version=2",
        )
    origin = pairs.get("origin", "center")
    if origin not in ("center", "corner"):
        raise InputError(
            f"is {origin!r:.60}", where=f"{path}: origin", remedy="use center or corner"
        )
    cameras = sorted({int(k.split(".")[1]) for k in pairs if re.fullmatch(r"camera\.\d+\.A", k)})
    prefix = "camera."
    if cameras:
        if index is None and len(cameras) > 1:
            raise InputError(
                f"contains the cameras {', '.join(map(str, cameras))}",
                where=path,
                remedy="choose one by --index",
            )
        chosen = cameras[0] if index is None else index
        if chosen not in cameras:
            raise InputError(
                f"contains no camera {chosen}",
                where=path,
                remedy=f"use --index {' or '.join(map(str, cameras))}",
            )
        prefix = f"camera.{chosen}."
    fields = {k.removeprefix(prefix): _numbers(v) for k, v in pairs.items() if k.startswith(prefix)}
    unknown = [k for k, v in fields.items() if re.fullmatch(r"[a-z]\d", k) and any(v)]
    unknown = [k for k in unknown if k not in _CALLAB]
    if unknown:
        raise InputError(
            f"has unknown coefficients {', '.join(unknown)}",
            where=path,
            remedy="calibrate with radial and tangential distortion alone",
        )
    matrix = fields.get("A", [])
    if len(matrix) != 9:
        raise InputError(
            "is not a 3x3 matrix", where=f"{path}: {prefix}A", remedy="write nine numbers"
        )
    width, height = (
        _single_number(fields, name, f"{path}: {prefix}{name}") for name in ("width", "height")
    )
    size = _size(width, height, path)
    shift = 0.5 if origin == "corner" else 0.0
    pinhole = [matrix[0], matrix[4], matrix[2] - shift, matrix[5] - shift]
    k = [fields.get(n, [0.0])[0] if fields.get(n) else 0.0 for n in DISTORTION_ORDER["brown"]]
    camera, warnings = _lens("brown", pinhole, matrix[1], k, size, path)
    return LensFile(camera, "callab", warnings)


def _opencv(text: str, path: Path) -> LensFile:
    """Read OpenCV's YAML, XML or JSON, and the camera_info of ROS, which is similar."""
    matrix = _array(
        text, ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "intrinsic_matrix")
    )
    if matrix is None or len(matrix) != 9:
        raise InputError(
            "contains no known lens (fc of Bouguet's toolbox, camera.A of CalLab, "
            "camera_matrix of OpenCV or ROS)",
            where=path,
            remedy="check the file",
        )
    names = (
        "distortion_coefficients", "Distortion_Coefficients", "distortion_coeffs", "distCoeffs",
        "dist_coeffs", "D",
    )  # fmt: skip
    k = _array(text, names) or []
    image_size = _array(text, ("image_size", "imageSize", "resolution")) or []
    width = _scalar(text, ("image_width", "image_Width", "imageWidth", "width"))
    height = _scalar(text, ("image_height", "image_Height", "imageHeight", "height"))
    if width is None and height is None and len(image_size) == 2:
        width, height = image_size
    if width is None or height is None:
        raise InputError(
            "doesn't state the image size",
            where=path,
            remedy="add image_width and image_height",
        )
    distortion_model = re.search(r"""distortion_model["']?\s*:\s*["']?(\w+)""", text)
    is_ros = distortion_model is not None
    model = _ROS_MODELS.get(distortion_model[1].lower()) if distortion_model else None
    if distortion_model and model is None:
        raise InputError(
            f"is {distortion_model[1]!r:.40}",
            where=f"{path}: distortion_model",
            remedy=f"use one of {', '.join(_ROS_MODELS)}",
        )
    fisheye = _scalar(text, ("fisheye_model",))
    if model is None:
        model = "fisheye" if fisheye else ("brown" if len(k) <= 5 else "rational")
    pinhole = [matrix[0], matrix[4], matrix[2], matrix[5]]
    camera, warnings = _lens(model, pinhole, matrix[1], k, _size(width, height, path), path)
    return LensFile(camera, "ros" if is_ros else "opencv", warnings)


def _array(text: str, names: tuple[str, ...]) -> list[float] | None:
    """Return the numbers of the first of these keys in YAML, JSON or XML; None if there is none."""
    for name in names:
        xml = re.search(rf"<{name}\b[^>]*>(.*?)</{name}>", text, re.DOTALL)
        if xml:
            data = re.search(r"<data>(.*?)</data>", xml[1], re.DOTALL)
            return _numbers(data[1] if data else xml[1])
        # Everything after the key; then everything after `data:`, if present.
        yaml = re.search(rf"""(?:^|[{{,])\s*["']?{name}["']?\s*:(.*)""", text, re.M | re.DOTALL)
        if yaml:
            body = yaml[1]
            data = re.match(r"[^\[]{0,200}?[\"']?data[\"']?\s*:", body, re.DOTALL)
            body = body[data.end() :] if data else body
            flow = re.match(r"\s*(?:!!\S+\s*)?\[((?:[^\[\]]|\[[^\[\]]*\])*)\]", body)
            if flow:
                return _numbers(flow[1])
            block = re.match(rf"\s*\n((?:\s*-\s*(?:-\s*)?{_NUMBER}\s*(?:\n|$))+)", body)
            if block:
                return [float(v) for v in re.findall(rf"-\s+({_NUMBER})\s*$", block[1], re.M)]
    return None


def _scalar(text: str, names: tuple[str, ...]) -> float | None:
    for name in names:
        match = re.search(rf"""<{name}>\s*({_NUMBER})\s*</""", text) or re.search(
            rf"""(?:^|[{{,])\s*["']?{name}["']?\s*:\s*({_NUMBER})\b""", text, re.MULTILINE
        )
        if match:
            return _number(match[1])
    return None


def _numbers(text: str) -> list[float]:
    return [_number(value) for value in re.findall(_NUMBER, text)]


def _number(text: str) -> float:
    return float(text.replace("d", "e").replace("D", "e"))


def _single_number(values: dict[str, list[float]], name: str, where: str) -> float:
    numbers = values.get(name, [])
    if len(numbers) != 1:
        raise InputError("is missing", where=where, remedy="use a number")
    return numbers[0]


def _size(width: float, height: float, path: Path) -> tuple[int, int]:
    if not (2 <= width <= 16384 and 2 <= height <= 16384):
        raise InputError(
            f"is {width:g} x {height:g}", where=f"{path}: image size", remedy="state it in pixels"
        )
    return round(width), round(height)


def _lens(
    model: str,
    pinhole: list[float],
    skew: float,
    k: list[float],
    size: tuple[int, int],
    path: Path,
) -> tuple[Camera, tuple[str, ...]]:
    """Build a lens from fx, fy, cx, cy and coefficients in OpenCV's order."""
    values = dict(zip(("fx", "fy", "cx", "cy"), pinhole, strict=True))
    order = DISTORTION_ORDER[model]
    values |= dict(zip(order, k, strict=False))
    camera = checked_lens(MODELS[model], size, values, path)
    extra = k[len(order) :]
    if not np.isfinite(extra).all() or len(k) > 14:
        raise InputError(
            f"has {len(k)} distortion coefficients", where=path, remedy="use 14 at most"
        )
    if any(extra) and model == "fisheye":
        raise InputError(
            f"has {len(k)} distortion coefficients for a fisheye lens",
            where=path,
            remedy="use four",
        )
    if any(extra):
        table = _opencv_rays(camera, skew, k)
        return table, ("thin prism or tilted sensor: the lens becomes a table of rays",)
    if abs(skew) * size[1] / camera.fy > MAX_SKEW_PX:
        if not abs(skew) <= camera.fx:
            raise InputError(f"is {skew}", where=f"{path}: skew", remedy="use 0, or pixels")
        return _skewed_rays(camera, skew), (
            f"a skew of {skew:.3g} px: the lens becomes a table of rays",
        )
    return camera, ()


def _normalised(camera: Pinhole, skew: float) -> Float64:
    """Return (H, W, 2) distorted x/z, y/z: u = fx x + skew y + cx, v = fy y + cy."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
    y = (v - camera.cy) / camera.fy
    return np.stack([(u - camera.cx - skew * y) / camera.fx, y], -1)


def _skewed_rays(camera: Pinhole, skew: float) -> RayTable:
    return RayTable(camera._undistort(_normalised(camera, skew)).astype(np.float32))


def _opencv_rays(camera: Pinhole, skew: float, k: list[float]) -> RayTable:
    """Return the rays of a lens with up to 14 coefficients of OpenCV's model."""
    lens = _OpenCVLens(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, tuple(k)
    )
    return RayTable(lens._undistort(_normalised(camera, skew)).astype(np.float32))


@dataclass(frozen=True)
class _OpenCVLens(Pinhole):
    """A lens with all of OpenCV's distortion coefficients."""

    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        pass  # checked before

    def _distort(self, xy: Float64) -> Float64:
        points = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], -1).reshape(-1, 1, 3)
        coefficients = np.array([*self.coefficients, *([0.0] * (14 - len(self.coefficients)))])
        out = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), coefficients)[0]
        return np.asarray(out, float).reshape(xy.shape)
