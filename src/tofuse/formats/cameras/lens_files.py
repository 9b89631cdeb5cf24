"""Lenses in the calibration files of other programs.

Pixel coordinate 0 is at the centre of the first pixel, as in tofuse; only in nerfstudio's files it
is at the corner.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import DISTORTION_ORDER
from tofuse.engine.errors import InputError
from tofuse.formats.files import tables

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_ROS_MODELS = {
    "plumb_bob": "brown",
    "rational_polynomial": "rational",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
    "radtan": "brown",  # Kalibr
    "none": "brown",
}
# The names that programs give to the same field: OpenCV, ROS (of version 2 in lower case), Open3D,
# Kalibr, ORB-SLAM, nerfstudio.
_MATRIX = (
    *("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "k", "intrinsic_matrix"),
    *("intrinsics", "intrinsic"),
)
_DISTORTION = (
    *("distortion_coefficients", "Distortion_Coefficients", "distortion_coeffs"),
    *("distCoeffs", "dist_coeffs", "distortion", "D", "d", "coeffs"),
)
_SIZE = ("image_size", "imageSize", "resolution")
_WIDTH = ("image_width", "image_Width", "imageWidth", "width", "Camera.width", "w")
_HEIGHT = ("image_height", "image_Height", "imageHeight", "height", "Camera.height", "h")
_PREFIXES = ("", "Camera.", "Camera1.")
_NERFSTUDIO = "fl_x"
_LENS = (("fx", _NERFSTUDIO), ("fy", "fl_y"), ("cx", "ppx"), ("cy", "ppy"))
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_UNIT, _KIND = "depth_unit_m", "depth_kind"
_COUNTS = ("DepthMapFactor", "RGBD.DepthMapFactor", "depth_scale")
_UNREAD = "use fx, fy, cx, cy and the coefficients k1, k2, p1, p2, k3 as keys, or a camera.json"


@dataclass(frozen=True, eq=False)
class LensFile:
    """Content of a calibration file.

    Attributes
    ----------
    format
        "opencv" (or any program that names its matrix alike), "ros" or "numbers".
    K
        (3, 3) matrix in pixels.
    model, distortion
        The lens model, and its coefficients in the order of `DISTORTION_ORDER`.
    size
        (width, height) of the images; None if it is not stated.
    depth_unit_m, depth_kind
        Of depth, as in camera.json; None if they are not stated.
    """

    format: str
    K: Float64
    model: str
    distortion: tuple[float, ...] = ()
    size: tuple[float, float] | None = None
    depth_unit_m: float | None = None
    depth_kind: str | None = None


def parse_lens_file(text: str, path: str | Path) -> LensFile:
    """Parse YAML, JSON or XML of OpenCV, ROS, Kalibr, Open3D or ORB-SLAM, or bare numbers.

    Bare numbers are a matrix of 3 x 3, or fx, fy, cx, cy.

    Parameters
    ----------
    text
        Content of the file.
    path
        The file, for errors.

    Raises
    ------
    InputError
        If it states no lens, or one that no model here describes.
    """
    keys = _Keys(text, path)
    K, file_format = keys.matrix(), "opencv"
    if K is None:
        K, file_format = _bare_matrix(keys), "numbers"
    k = keys.distortion()
    ros_model = keys.word("distortion_model")
    if ros_model is not None:
        file_format, model = "ros", _ROS_MODELS.get(ros_model.lower(), "")
        if not model:
            raise InputError(
                f"is {ros_model!r:.40}",
                where=f"{path}: distortion_model",
                remedy=f"use one of {', '.join(_ROS_MODELS)}",
            )
    elif any(keys.numbers("fisheye_model") or ()):
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
    return LensFile(
        file_format, K, model, k[: len(order)], keys.size(), keys.unit(), keys.word(_KIND)
    )


class _Keys:
    """The values of keys in YAML, JSON or XML, whatever they are nested in."""

    def __init__(self, text: str, path: str | Path) -> None:
        # Of OpenCV's arrays of one dimension, before their data.
        self.text = re.sub(r"""["']?sizes["']?\s*:\s*\[[^\]]*\]\s*,?""", "", text)
        self.path = path

    def _after(self, name: str) -> list[str]:
        """All that follows each occurrence of a key, of XML its content."""
        name = re.escape(name)
        xml = re.findall(rf"<{name}\b[^>]*>(.*?)</{name}>", self.text, re.DOTALL)
        key = re.compile(rf"""(?:^|[{{,])[ \t\r\n]*(?:-\s+)?["']?{name}["']?\s*[:=]""", re.M)
        return xml or [self.text[match.end() :] for match in key.finditer(self.text)]

    def numbers(self, *names: str) -> tuple[float, ...] | None:
        """The numbers of the first of these keys that there is; None without any."""
        for name in names:
            found = self._after(name)
            if len({_values(body) for body in found}) > 1:
                raise InputError(
                    f"has {len(found)} cameras", where=self.path, remedy="leave that of depth"
                )
            if found:
                values = _values(found[0])
                if values is None:
                    raise InputError(
                        "is not understood", where=f"{self.path}: {name}", remedy=_UNREAD
                    )
                return values
        return None

    def number(self, *names: str) -> float | None:
        """The number of the first of these keys that there is; None without any."""
        values = self.numbers(*(p + name for name in names for p in _PREFIXES))
        return values[0] if values else None

    def word(self, name: str) -> str | None:
        """The word of a key."""
        for body in self._after(name):
            if match := re.match(r"""\s*["']?(\w+)""", body):
                return match[1]
        return None

    def matrix(self) -> Float64 | None:
        """The matrix (3, 3); None if it has no key."""
        values = self.numbers(*_MATRIX)
        if values is not None and len(values) == 4:  # Kalibr's order
            return _matrix(values)
        if values is not None:
            K = np.reshape(values, (3, 3)) if len(values) == 9 else None
            if K is None:
                raise self.no_lens()
            if K[2, :2].any() and not K[:2, 2].any():  # Open3D writes it column by column
                K = K.T
            return K
        lens = [self.number(*names) for names in _LENS]
        if None in lens:
            return None
        K = _matrix(tuple(value for value in lens if value is not None))
        if self.number(_NERFSTUDIO) is not None:
            K[:2, 2] -= 0.5
        return K

    def distortion(self) -> tuple[float, ...]:
        """The coefficients in the order of OpenCV."""
        single = [self.number(name) for name in _COEFFICIENTS]
        if any(value is not None for value in single):
            count = len(single) if any(single[5:]) else 5
            return tuple(value or 0.0 for value in single[:count])
        values = self.numbers(*_DISTORTION)
        if values is not None:
            return values
        if re.search(r"(?i)(?<!un)dist(?!ance|ortion_model)", self.text):
            raise InputError(
                "has a distortion that is not understood", where=self.path, remedy=_UNREAD
            )
        return ()

    def size(self) -> tuple[float, float] | None:
        """Width and height; None if they are not stated."""
        sides = self.number(*_WIDTH), self.number(*_HEIGHT)
        if sides[0] is not None and sides[1] is not None:
            return sides[0], sides[1]
        values = self.numbers(*_SIZE) or ()
        return (values[0], values[1]) if len(values) == 2 else None

    def unit(self) -> float | None:
        """Metres of one count of depth; None if they are not stated."""
        stated = self.number(_UNIT)
        if stated is not None:
            return stated
        counts = self.number(*_COUNTS)
        if counts is None or not counts > 0:
            return None
        return counts if counts < 1 else 1 / counts  # librealsense states metres per count

    def no_lens(self) -> InputError:
        """The error of a file without a lens."""
        return InputError(
            "contains no known lens (camera_matrix of OpenCV or ROS; fx, fy, cx, cy)",
            where=self.path,
            remedy="check the file",
        )


def _bare_matrix(keys: _Keys) -> Float64:
    """The matrix of a text of numbers, next to which keys may state size and unit."""
    lines = [line for line in keys.text.splitlines() if not re.match(r"\s*[A-Za-z]", line)]
    try:
        table = tables.parse_numbers("\n".join(lines), keys.path)
    except InputError:
        raise keys.no_lens() from None
    if table.size == 4:
        return _matrix(tuple(table.ravel().tolist()))
    if table.shape in ((1, 9), (9, 1)):
        table = table.reshape(3, 3)
    if table.shape not in ((3, 3), (3, 4), (4, 4)):
        raise keys.no_lens()
    return table[:3, :3]


def _matrix(lens: tuple[float, ...]) -> Float64:
    """The matrix (3, 3) of fx, fy, cx, cy."""
    fx, fy, cx, cy = lens
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _values(body: str) -> tuple[float, ...] | None:
    """Return the numbers with which the text after a key begins; None if it is none of these."""
    if "<" in body and (data := re.search(r"<data>(.*?)</data>", body, re.DOTALL)):
        return tuple(float(value) for value in re.findall(_NUMBER, data[1]))
    if single := re.match(rf"""\s*["']?({_NUMBER})["']?\s*(?=[\s,;}}#<]|$)""", body):
        rest = re.match(rf"\s*{_NUMBER}(?:[ \t,]+{_NUMBER})+\s*(?:\n|$)", body)
        numbers = re.findall(_NUMBER, rest[0]) if rest else [single[1]]
        return tuple(float(value) for value in numbers)
    data = re.match(r"[^\[]{0,200}?[\"']?data[\"']?\s*:", body, re.DOTALL)
    body = body[data.end() :] if data else body
    block = re.match(rf"\s*\n((?:\s*-\s*(?:-\s*)?{_NUMBER}\s*(?:\n|$))+)", body)
    if block:
        return tuple(float(v) for v in re.findall(rf"-\s+({_NUMBER})\s*$", block[1], re.M))
    flow = re.match(r"\s*(?:!!\S+\s*)?\[((?:[^\[\]]|\[[^\[\]]*\])*)\]", body)
    rows = re.match(r"\s*\n((?:\s*-\s*\[[^\[\]]*\]\s*(?:\n|$))+)", body)
    found = flow or rows
    return None if found is None else tuple(float(v) for v in re.findall(_NUMBER, found[1]))
