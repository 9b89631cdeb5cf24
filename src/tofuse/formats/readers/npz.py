"""Reader of NumPy archives with a few named arrays, for formats without a dedicated reader."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import DISTORTION_ORDER, MODELS, Camera, RayTable, pinhole_values
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame, depth_counts
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import npz, reading
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs, pixels

MAX_BYTES = 1 << 30
_IMAGES = {"amplitude": 3, "confidence": 3, "sigma": 3, "color": 4}
_FLOATS = ("amplitude", "sigma")
_TABLES = ("timestamps", "reference", "odometry", "K", "rays", "distortion")
_VALUES = (
    *("depth_unit_m", "depth_kind", "model", "frame_rate_hz", "ambiguity_m", "confidence_max"),
    *("amplitude_kind", "sensor"),
)
_NAMES = ("depth", *_IMAGES, *_TABLES, *_VALUES)


@part("reader", "npz", label="validated")
class Npz(Reader):
    """A .npz file with depth (N, H, W), a camera (K or rays), and optional channels."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        file = inputs.file_of(path, ".npz")
        try:
            if file is not None and reading.read_head(file, 2) == b"PK":
                with zipfile.ZipFile(file) as archive:
                    if "depth.npy" in archive.namelist():
                        return Sniff(1.0, "a NumPy archive with depth")
        except (InputError, OSError, ValueError, zipfile.BadZipFile, NotImplementedError):
            pass
        return None

    def open(self, path: Path, options: ReaderOptions) -> NpzSource:
        """See `Reader.open`."""
        return NpzSource(inputs.required_file(path, ".npz"), options)


class NpzSource(FileSource):
    """Frames from arrays in memory."""

    def __init__(self, path: Path, options: ReaderOptions) -> None:
        self.path = path
        arrays = npz.read_npz(path, limit=MAX_BYTES)
        if "depth" not in arrays:
            raise self._error("depth", "is missing", "save depth as (N, H, W)")
        depth = arrays["depth"]
        if depth.ndim == 2:
            depth = depth[None]
        if depth.ndim != 3 or depth.dtype.kind not in "fui" or min(depth.shape[1:]) < 2:
            raise self._error(
                "depth", f"has shape {depth.shape} and type {depth.dtype}", "save (N, H, W) numbers"
            )
        self.depth = depth
        self.kind = self._text(arrays, "depth_kind", "z", ("z", "range"))
        self.amplitude_kind = self._text(
            arrays, "amplitude_kind", "raw", camera_file.AMPLITUDE_KINDS
        )
        self.camera, self.unit = self._read_camera(arrays, options)
        self.images = {
            name: self._images(arrays[name], name, ndim)
            for name, ndim in _IMAGES.items()
            if name in arrays
        }
        super().__init__(self._times(arrays))
        inputs.check_timestamps(self.timestamps, Path(f"{path}: timestamps"), self.warnings)
        self.reference = self._poses(arrays, "reference")
        self.odometry = self._poses(arrays, "odometry")
        self.metadata |= {"depth_kind": self.kind}
        if depth.dtype.kind != "f":
            self.metadata["depth_unit_m"] = self.unit
        for name in ("frame_rate_hz", "ambiguity_m", "confidence_max"):
            if name in arrays:
                self.metadata[name] = self._number(arrays, name)
        self.ambiguity_m = self.metadata.get("ambiguity_m")
        if "sensor" in arrays:
            self.metadata["sensor"] = str(arrays["sensor"])[:200]
        unknown = [name for name in arrays if name not in _NAMES]
        if unknown:
            self.warnings.append(f"{path}: unknown arrays ignored: {', '.join(unknown)[:200]}")

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        images = {
            f"{name}_image": pixels.finite_float32(stack[index])
            if name in _FLOATS
            else stack[index]
            for name, stack in self.images.items()
        }
        return self.image(
            index, depth_counts.depth_from_numbers(self.depth[index], self.unit), **images
        )

    def _read_camera(
        self, arrays: dict[str, NDArray[Any]], options: ReaderOptions
    ) -> tuple[Camera, float]:
        unit = 1.0
        if self.depth.dtype.kind != "f" or "depth_unit_m" in arrays:
            if "depth_unit_m" not in arrays and options.camera is None:
                raise self._error(
                    "depth_unit_m",
                    "is missing, but depth has whole numbers",
                    "save the metres per count, such as 0.001",
                )
            unit = self._number(arrays, "depth_unit_m") if "depth_unit_m" in arrays else 1.0
        height, width = self.depth.shape[1:]
        camera: Camera
        if options.camera is not None:
            description, camera = camera_file.load_camera(options.camera, (width, height))
            self.kind = description.depth_kind
            if self.depth.dtype.kind != "f":  # floats are in metres
                unit = description.depth_unit_m
        elif "rays" in arrays:
            rays = self._floats(arrays, "rays")
            if rays.shape != (height, width, 2):
                raise self._error("rays", f"has shape {rays.shape}", "save (H, W, 2), as depth")
            rays[~(np.abs(rays) < camera_file.MAX_SLOPE).all(-1)] = np.nan
            try:
                camera = RayTable(rays.astype(np.float32))
            except InputError as error:
                raise self._error("rays", error.problem, "save x/z and y/z") from error
        else:
            camera = self._lens(arrays, width, height)
        if (camera.width, camera.height) != (width, height):
            raise self._error(
                "depth",
                f"is {width} x {height}, the camera {camera.width} x {camera.height}",
                "pass the camera of these images",
            )
        if not 1e-9 <= unit <= 1:
            raise self._error("depth_unit_m", f"is {unit}", "save the metres per count")
        return camera, unit

    def _lens(self, arrays: dict[str, NDArray[Any]], width: int, height: int) -> Camera:
        if "K" not in arrays:
            raise self._error("K", "is missing, and so is rays", "save one, or use --camera")
        K = self._floats(arrays, "K")
        if K.shape != (3, 3):
            raise self._error("K", f"has shape {K.shape}", "save (3, 3)")
        values: dict[str, Any] = {**pinhole_values(K, self.depth.shape, f"{self.path}: K")}
        distortion = np.zeros(0)
        if "distortion" in arrays:
            distortion = self._floats(arrays, "distortion").ravel()
        default = (
            "pinhole" if not len(distortion) else "rational" if len(distortion) > 5 else "brown"
        )
        model = self._text(arrays, "model", default, tuple(MODELS))
        order = DISTORTION_ORDER[model]
        if len(distortion) > len(order):
            raise self._error(
                "distortion", f"has {len(distortion)} numbers", f"{model} takes {len(order)}"
            )
        values |= dict(zip(order, distortion, strict=False))
        numbers = {name: float(value) for name, value in values.items()}
        return camera_file.checked_lens(MODELS[model], (width, height), numbers, f"{self.path}: K")

    def _images(self, stack: NDArray[Any], name: str, ndim: int) -> NDArray[Any]:
        stack = stack[None] if stack.ndim == ndim - 1 else stack
        expected = (*self.depth.shape, 3)[:ndim]
        is_uint8 = name in ("confidence", "color")
        if stack.shape != expected or stack.dtype.kind not in ("u" if is_uint8 else "fui"):
            raise self._error(
                name, f"has shape {stack.shape} and type {stack.dtype}", f"save {expected}"
            )
        if is_uint8 and stack.dtype != np.uint8:
            raise self._error(name, f"has type {stack.dtype}", "save uint8")
        return stack

    def _times(self, arrays: dict[str, NDArray[Any]]) -> Float64:
        count = len(self.depth)
        if "timestamps" not in arrays:
            rate = self._number(arrays, "frame_rate_hz") if "frame_rate_hz" in arrays else 1.0
            return np.arange(count) / rate
        times = self._floats(arrays, "timestamps").ravel()
        if len(times) != count:
            raise self._error(
                "timestamps",
                f"has {quantities.count(len(times), 'value')}",
                f"save {count}, as depth",
            )
        return times

    def _poses(self, arrays: dict[str, NDArray[Any]], name: str) -> Float64 | None:
        if name not in arrays:
            return None
        poses = self._floats(arrays, name)
        if poses.shape != (len(self.depth), 4, 4):
            raise self._error(name, f"has shape {poses.shape}", "save (N, 4, 4) T_world_camera")
        where = f"{self.path}: {name}"
        return np.stack([inputs.read_matrix_pose(T, f"{where}[{k}]") for k, T in enumerate(poses)])

    def _floats(self, arrays: dict[str, NDArray[Any]], name: str) -> Float64:
        if arrays[name].dtype.kind not in "fui":
            raise self._error(name, f"has type {arrays[name].dtype}", "save numbers")
        with np.errstate(all="ignore"):
            return arrays[name].astype(float)

    def _number(self, arrays: dict[str, NDArray[Any]], name: str) -> float:
        values = self._floats(arrays, name).ravel()
        if len(values) != 1 or not np.isfinite(values[0]) or values[0] <= 0:
            raise self._error(name, "isn't a positive number", "save one number")
        return float(values[0])

    def _text(
        self, arrays: dict[str, NDArray[Any]], name: str, default: str, choices: tuple[str, ...]
    ) -> Any:
        value = str(arrays[name]) if name in arrays else default
        if value not in choices:
            raise self._error(name, f"is {value!r:.60}", f"save one of {', '.join(choices)}")
        return value

    def _error(self, name: str, problem: str, remedy: str) -> InputError:
        return InputError(problem, where=f"{self.path}: {name}", remedy=remedy)
