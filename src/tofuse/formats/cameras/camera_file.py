"""camera.json, the description of the camera of a native recording, and files in its place."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import (
    DISTORTION_ORDER,
    MODELS,
    Camera,
    Pinhole,
    RayTable,
    pinhole_values,
    scaled,
)
from tofuse.engine.errors import InputError
from tofuse.engine.frames import AmplitudeKind, DepthKind
from tofuse.engine.geometry import se3
from tofuse.formats.cameras import lens_files
from tofuse.formats.files import npz, reading

SizeOf = Callable[[], tuple[int, int]]

# Limits for any camera: a frame per month to a million per second; ambiguity ranges of modulation
# at 15 GHz to 1.5 kHz.
_RATES_HZ = (1e-7, 1e6)
_PERIODS_M = (0.01, 1e5)

SCHEMA = 1
MAX_SLOPE = 1e4  # of a ray: 89.99 degrees off the axis
AMPLITUDE_KINDS = ("raw", "range_compensated", "ir")

_FOREIGN = "correct it, or convert a file of another program by `tofuse calibrate import`"
_MAX_BYTES = 64 << 20
_METRES = "the metres of one count, such as 0.001"
# Of a JSON object that is meant for a camera.json.
_OWN = {"schema", "model"}
_LENS = ("model", "width", "height", "fx", "fy", "cx", "cy", "distortion")


@dataclass(frozen=True, eq=False)
class ColorCamera:
    """The camera of colour images that are not registered to depth.

    `T_color_depth` (4, 4) maps points in m from the depth camera's frame to the colour camera's.
    """

    camera: Pinhole
    T_color_depth: Float64


@dataclass(frozen=True, eq=False)
class CameraFile:
    """Content of a camera.json.

    Attributes
    ----------
    camera
        None if the model is "rays" (it is in rays.npy then), and for clouds.
    size
        (width, height), or None for clouds.
    depth_unit_m
        Metres per count.
    depth_kind
        "z" or "range".
    frame_rate_hz, ambiguity_m, confidence_max, amplitude_kind, sigma_unit_m, sensor, serial,
    poses_by
        See the native format in docs/formats.md; None where not given.
    color_registered
        Whether colour without its own camera is registered to depth.
    color
        The colour camera, unless colour has the pixels of depth.
    unknown
        Unknown keys.
    program
        Of a file of another program its `LensFile.format`; None for a camera.json.
    """

    camera: Pinhole | None
    size: tuple[int, int] | None
    depth_unit_m: float = 0.001
    depth_kind: DepthKind = "z"
    frame_rate_hz: float | None = None
    ambiguity_m: float | None = None
    confidence_max: float | None = None
    amplitude_kind: AmplitudeKind | None = None
    sigma_unit_m: float | None = None
    sensor: str | None = None
    serial: str | None = None
    poses_by: str | None = None
    color_registered: bool = True
    color: ColorCamera | None = None
    unknown: tuple[str, ...] = ()
    program: str | None = None

    @property
    def metadata(self) -> dict[str, Any]:
        """Metadata of a recording's depth and sensor."""
        return {"depth_kind": self.depth_kind, **self.stated("sensor", "serial")}

    def stated(self, *names: str) -> dict[str, Any]:
        """Return those of the named attributes that are given."""
        values = {name: getattr(self, name) for name in names}
        return {name: value for name, value in values.items() if value is not None}


_KEYS = {field.name for field in fields(CameraFile)} - {*("camera", "size", "unknown", "program")}


def read_camera_file(path: str | Path, *, clouds: bool = False) -> CameraFile:
    """Read and check a camera.json.

    Parameters
    ----------
    path
        The file.
    clouds
        Whether the recording has clouds, which need no camera.

    Raises
    ------
    InputError
        Naming file and field, with a remedy.
    """
    data = reading.parse_json(reading.read_text(path, limit=_MAX_BYTES), path, _FOREIGN)
    get = _Fields(data, str(path))
    if "schema" not in data:
        raise InputError("has no schema, and is no camera.json", where=path, remedy=_FOREIGN)
    with reading.about(path):
        reading.check_schema(data, SCHEMA)
    camera = size = None
    color = None
    unit = 0.001
    kind: DepthKind = "z"
    if not (clouds and "model" not in data):
        camera, size = _lens(get)
        unit = get.depth_unit(required=True) or 0.001
        kind = get.choice("depth_kind", ("z", "range"), required=True)  # type: ignore[assignment]
        color = _color(get)
    return CameraFile(
        camera,
        size,
        unit,
        kind,
        get.within("frame_rate_hz", *_RATES_HZ),
        get.within("ambiguity_m", *_PERIODS_M),
        get.positive("confidence_max"),
        get.choice("amplitude_kind", AMPLITUDE_KINDS),  # type: ignore[arg-type]
        get.positive("sigma_unit_m"),
        get.text("sensor"),
        get.text("serial"),
        get.text("poses_by"),
        get.flag("color_registered", default=True),
        color,
        tuple(key for key in data if key not in {"schema", *_LENS, *_KEYS}),
    )


def read_lens_file(path: str | Path, size_of_images: SizeOf | None = None) -> CameraFile:
    """Read the camera of depth from a calibration file of another program.

    What it does not state of depth is z in mm, see `assumption`; the rest is `parse_lens_file`.

    Parameters
    ----------
    path
        The file.
    size_of_images
        Returns width and height of the images, if the file does not state them.

    Raises
    ------
    InputError
        If it is no such file, or its values are invalid.
    """
    lens = lens_files.parse_lens_file(reading.read_text(path, limit=_MAX_BYTES), path)
    stated = lens.size or (None if size_of_images is None else size_of_images())
    if stated is None:
        raise InputError(
            "doesn't state the image size",
            where=path,
            remedy="add image_width and image_height to it, or pass --recording to "
            "`tofuse calibrate import`",
        )
    width, height = image_size(stated[0], stated[1], f"{path}: image size")
    values = pinhole_values(lens.K, (height, width), f"{path}: camera_matrix")
    order = DISTORTION_ORDER[lens.model]
    values |= dict(zip(order, lens.distortion, strict=False))
    camera = checked_lens(MODELS[lens.model], (width, height), values, path)
    get = _Fields({"depth_unit_m": lens.depth_unit_m, "depth_kind": lens.depth_kind}, str(path))
    unit, kind = get.depth_unit(), get.choice("depth_kind", ("z", "range"))
    return CameraFile(
        camera,
        (width, height),
        unit or 0.001,
        kind or "z",  # type: ignore[arg-type]
        program=lens.format,
    )


def _is_own(path: Path) -> bool:
    """Whether a file is meant for a camera.json, not of another program."""
    data: Any = None
    with suppress(InputError):
        data = reading.parse_json(reading.read_text(path, limit=_MAX_BYTES), path)
    return path.suffix.lower() == ".json" if data is None else bool(_OWN & data.keys())


def assumption(path: str | Path) -> str:
    """Return what is assumed of depth as a calibration file doesn't state it; empty if nothing."""
    path = Path(path)
    if _is_own(path):
        return ""
    lens = lens_files.parse_lens_file(reading.read_text(path, limit=_MAX_BYTES), path)
    stated = {
        "whole numbers of depth are mm (depth_unit_m)": lens.depth_unit_m,
        "depth is z (depth_kind)": lens.depth_kind,
    }
    assumed = " and ".join(text for text, value in stated.items() if value is None)
    return f"it is assumed that {assumed}; if not, add that key to {path}" if assumed else ""


def load_camera(
    path: str | Path,
    size: tuple[int, int] | None = None,
    size_of_images: SizeOf | None = None,
) -> tuple[CameraFile, Camera]:
    """Read a camera.json and the rays.npy in its folder, which overrides the lens model.

    Also a calibration file of another program, see `read_lens_file`.

    Parameters
    ----------
    path
        The file.
    size
        Expected width and height, if known.
    size_of_images
        Returns width and height of the images if `size` isn't known, for files without a size.

    Raises
    ------
    InputError
        As `read_camera_file`; also if the sizes differ, or the model is "rays" without a table.
    """
    path = Path(path)
    if _is_own(path):
        description = read_camera_file(path)
    else:
        description = read_lens_file(path, size_of_images if size is None else lambda: size)
    if size is not None and description.size != size:
        raise InputError(
            f"is of {' x '.join(map(str, description.size or ()))} pixels, depth of "
            f"{size[0]} x {size[1]}",
            where=path,
            remedy="pass the camera of these images",
        )
    table = path.parent / "rays.npy"
    if description.program is not None or not reading.is_file(table):
        if description.camera is None:
            raise InputError(
                "is 'rays' and there is no rays.npy",
                where=f"{path}: model",
                remedy="add rays.npy, or use a lens model",
            )
        return description, description.camera
    camera = read_rays(table)
    if description.size != (camera.width, camera.height):
        raise InputError(
            f"is {camera.width} x {camera.height}, {path.name} says "
            f"{' x '.join(map(str, description.size or ()))}",
            where=table,
            remedy="use the table of this camera",
        )
    return description, camera


def camera_file_of(folder: Path, camera_file: Path | None, content: str) -> Path:
    """Return the camera.json passed by the user, or else that of a recording's folder.

    Parameters
    ----------
    folder, camera_file
        The recording, and the file passed by the user, if any.
    content
        Content of files of this format, for the message, such as "neither size nor lens".

    Raises
    ------
    InputError
        If there is no such file.
    """
    path = camera_file or folder / "camera.json"
    if not reading.is_file(path):
        raise InputError(
            f"is missing: such files contain {content}",
            where=path,
            remedy="pass a camera.json with --camera",
        )
    return path


def check_size(image: NDArray[Any], camera: Camera, where: str | Path) -> None:
    """Raise InputError, naming `where`, unless an image (H, W, ...) has the size of its camera."""
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"is {image.shape[1]} x {image.shape[0]} pixels, its camera "
            f"{camera.width} x {camera.height}",
            where=where,
            remedy="pass the camera of these images with --camera",
        )


def read_rays(path: Path) -> RayTable:
    """Read a rays.npy: (H, W, 2) float32 of x/z and y/z."""
    table = npz.read_npy(path)
    if table.dtype.kind != "f" or table.ndim != 3 or table.shape[2] != 2:
        problem = f"is not a table of rays ({table.dtype} of shape {table.shape})"
        raise InputError(problem, where=path, remedy="save (H, W, 2) float32")
    rays = np.array(table, float)
    finite = np.isfinite(rays)
    directions = rays[finite.all(2)]
    with reading.named(path), reading.about("rays", "save (H, W, 2) float32"):
        if (np.abs(rays[finite]) > MAX_SLOPE).any():
            raise InputError("contains rays at 90 degrees from the optical axis or more")
        if not len(directions):
            raise InputError("has no pixel with a ray")
        if len(directions) > 1 and not np.ptp(directions, axis=0).any():
            raise InputError("has only equal rays")
        return RayTable(np.where(finite, rays, np.nan).astype(np.float32))


def camera_fields(camera: Camera) -> dict[str, Any]:
    """Return the fields of camera.json that describe a camera; only the size of a ray table."""
    if isinstance(camera, RayTable):
        return {"model": "rays", "width": camera.width, "height": camera.height}
    if not isinstance(camera, Pinhole):
        raise InputError(
            f"is {quantities.one(type(camera).__name__)}",
            where="camera",
            remedy="use one of the models, or a RayTable of its rays",
        )
    out: dict[str, Any] = {"model": camera.model, "width": camera.width, "height": camera.height}
    out |= {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
    if order := DISTORTION_ORDER[camera.model]:
        out["distortion"] = [float(getattr(camera, name)) for name in order]
    return out


class _Fields:
    """Checked access to the fields of an object, with errors that name file and field."""

    def __init__(self, data: dict[str, Any], where: str) -> None:
        self.data, self.where = data, where

    def error(self, field: str, problem: str, remedy: str) -> InputError:
        return InputError(problem, where=f"{self.where}: {field}", remedy=remedy)

    def number(self, field: str, *, required: bool = False, hint: str = "a number") -> float | None:
        if self.data.get(field) is None and not required:
            return None
        value = reading.number_in(self.data, field, self.where, remedy=f"use {hint}")
        if not math.isfinite(value):
            raise self.error(field, f"is {value}", "use a finite number")
        return value

    def positive(
        self, field: str, *, required: bool = False, hint: str = "a positive number"
    ) -> float | None:
        value = self.number(field, required=required, hint=hint)
        if value is not None and value <= 0:
            raise self.error(field, f"is {value}", f"use {hint}")
        return value

    def depth_unit(self, *, required: bool = False) -> float | None:
        unit = self.positive("depth_unit_m", required=required, hint=_METRES)
        if unit is not None and not 1e-9 <= unit <= 1:
            remedy = "set the metres per count, at most 1"
            raise self.error("depth_unit_m", f"is {unit}", remedy)
        return unit

    def within(self, field: str, low: float, high: float) -> float | None:
        value = self.positive(field)
        if value is not None and not low <= value <= high:
            raise self.error(field, f"is {value:g}", f"use a number from {low:g} to {high:g}")
        return value

    def pixels(self, field: str) -> int:
        value = self.number(field, required=True, hint="a number of pixels")
        if value is None or value != int(value) or not 2 <= value <= 16384:
            raise self.error(field, f"is {value}", "use a whole number of pixels, 2 to 16384")
        return int(value)

    def text(self, field: str) -> str | None:
        value = self.data.get(field)
        if value is not None and (not isinstance(value, str) or not value.isprintable()):
            raise self.error(field, f"is {value!r:.60}", "write a name on one line")
        return value if value is None else value[:200]

    def flag(self, field: str, *, default: bool) -> bool:
        value = self.data.get(field, default)
        if not isinstance(value, bool):
            raise self.error(field, f"is {value!r:.60}", "write true or false")
        return value

    def choice(self, field: str, choices: tuple[str, ...], *, required: bool = False) -> str | None:
        value = self.data.get(field)
        if value is None and not required:
            return None
        if value not in choices or not isinstance(value, str):
            problem = "is missing" if field not in self.data else f"is {value!r:.60}"
            raise self.error(field, problem, f"write one of {', '.join(choices)}")
        return value


def _lens(get: _Fields) -> tuple[Pinhole | None, tuple[int, int]]:
    model = get.choice("model", (*MODELS, "rays"), required=True)
    size = (get.pixels("width"), get.pixels("height"))
    if model == "rays" or model is None:
        return None, size
    values: dict[str, float] = {}
    for name in ("fx", "fy"):
        values[name] = get.positive(name, required=True) or 1.0
    for name in ("cx", "cy"):
        values[name] = get.number(name, required=True) or 0.0
    order = DISTORTION_ORDER[model]
    coefficients = get.data.get("distortion")
    coefficients = [] if coefficients is None else coefficients
    if not isinstance(coefficients, list):
        raise get.error("distortion", f"is {coefficients!r:.60}", f"use a list [{' '.join(order)}]")
    for k, value in enumerate(coefficients):
        _Fields({f"distortion[{k}]": value}, get.where).number(f"distortion[{k}]", required=True)
    if any(coefficients[len(order) :]):
        raise get.error(
            "distortion",
            f"has {quantities.count(len(coefficients), 'number')}, "
            f"the model {model!r} takes {len(order)}",
            f"use [{' '.join(order)}], or another model",
        )
    values |= {name: float(v) for name, v in zip(order, coefficients, strict=False)}
    return checked_lens(MODELS[model], size, values, get.where), size


def image_size(width: float, height: float, where: str | Path) -> tuple[int, int]:
    """Return (width, height) from a file in whole pixels; InputError if no image has this size."""
    if not (2 <= width <= 16384 and 2 <= height <= 16384):
        raise InputError(f"is {width:g} x {height:g}", where=where, remedy="give pixels")
    return int(width), int(height)


def checked_lens(
    cls: type[Pinhole], size: tuple[int, int], values: dict[str, float], where: str | Path
) -> Pinhole:
    """Return a camera with parameters from a file.

    Parameters
    ----------
    cls
        The lens model.
    size
        (width, height) in pixels.
    values
        The other parameters by name.
    where
        The file, for errors.

    Raises
    ------
    InputError
        Naming the file and the parameter, if it isn't finite or plausible.
    """
    for name, value in values.items():
        low = 0.01 if name in ("fx", "fy") else -1e6
        if not low <= value <= 1e6:
            raise InputError(
                f"is {value}", where=f"{where}: {name}", remedy=f"use {low:g} to 1000000"
            )
    with reading.prefixed(where):
        return cls(size[0], size[1], **values)


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> Float64:
    """Return the matrix (3, 3) of focal lengths and principal point, in pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def depth_unit(counts_per_metre: float, where: str | Path) -> float:
    """Return the metres of one count of depth.

    Raises
    ------
    InputError
        Naming `where`, if it is no plausible number of counts in a metre.
    """
    if not 10 <= counts_per_metre <= 1e6:
        raise InputError(
            f"is {counts_per_metre:g}, which are no counts of depth in a metre",
            where=where,
            remedy="write the counts of depth in a metre, such as 1000",
        )
    return 1 / counts_per_metre


def checked_pinhole(K: Float64, size: tuple[int, int], where: str | Path) -> Pinhole:
    """Return the camera of a matrix from a file.

    Parameters
    ----------
    K
        (3, 3) of focal lengths and principal point, or larger.
    size
        (width, height) in pixels.
    where
        The file, for errors.

    Raises
    ------
    InputError
        See `checked_lens`.
    """
    (fx, _, cx), (_, fy, cy) = K[:2, :3].astype(float).tolist()
    return checked_lens(Pinhole, size, {"fx": fx, "fy": fy, "cx": cx, "cy": cy}, where)


def scaled_lens(camera: Pinhole, size: tuple[int, int], where: str | Path, remedy: str) -> Pinhole:
    """Return the lens of the same images at another size (width, height).

    Raises
    ------
    InputError
        If that has another aspect ratio: the images are turned or cropped, or of another camera.
    """
    width, height = camera.width, camera.height
    if abs(width * size[1] - height * size[0]) > 0.02 * height * size[0]:
        raise InputError(
            f"is of a {width} x {height} image, depth {size[0]} x {size[1]}: another aspect ratio",
            where=where,
            remedy=remedy,
        )
    with reading.named(where):
        return scaled(camera, *size)


def _color(get: _Fields) -> ColorCamera | None:
    data = get.data.get("color")
    if data is None:
        return None
    if not isinstance(data, dict) or not isinstance(data.get("intrinsics"), dict):
        raise get.error("color", "has no intrinsics", "use {intrinsics: {...}, T_color_depth: ...}")
    camera, _ = _lens(
        _Fields({"model": "pinhole"} | data["intrinsics"], f"{get.where}: color.intrinsics")
    )
    if camera is None:
        raise get.error("color.intrinsics.model", "is 'rays'", "use a lens model")
    field = "color.T_color_depth"
    where = f"{get.where}: {field}"
    matrix = reading.matrix_of(data.get("T_color_depth"), where, "use four rows of four numbers")
    return ColorCamera(camera, se3.check_pose(matrix, where=where))


# Columns of frames.csv that give each frame its own lens.
LENS_COLUMNS = ("fx", "fy", "cx", "cy")


def same_distortion(a: Pinhole, b: Pinhole) -> bool:
    """Whether two lenses differ only in focal lengths and principal point."""
    return type(a) is type(b) and all(
        getattr(a, f.name) == getattr(b, f.name) for f in fields(a) if f.name not in LENS_COLUMNS
    )
