"""E57 (ASTM E2807): clouds, written by pye57 (extra `scan`)."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.errors import InputError, OutputError
from tofuse.engine.fusion import GeometryRecord
from tofuse.formats.files import atomic, reading

_NORMALS = "http://www.libe57.org/E57_EXT_surface_normals.txt"
_TOFUSE = "https://tofuse.org/e57"


def write_e57(path: str | Path, cloud: GeometryRecord) -> None:
    """Write a cloud as one scan.

    In single precision, except for map coordinates in float64.

    Normals use the extension for surface normals, scalars an extension of tofuse, `tofuse:`.

    Parameters
    ----------
    path
        The file; see `replacing` for errors.
    cloud
        Of at least one point.

    Raises
    ------
    InputError
        If the shapes disagree, the library is not installed, or there are no points.
    """
    cloud.check(path)
    pye57 = reading.required_package("pye57", "scan", path)
    if not len(cloud):
        raise InputError("there are no points", where=path, remedy="E57 can't store an empty cloud")
    xyz = cloud.written_points()
    columns: dict[str, NDArray[Any]] = {f"cartesian{a}": xyz[:, k] for k, a in enumerate("XYZ")}
    if cloud.normals is not None:
        table = np.asarray(cloud.normals, np.float32)
        columns |= {f"nor:normal{a}": table[:, k] for k, a in enumerate("XYZ")}
    if cloud.color is not None:
        rgb = np.asarray(cloud.color, np.uint8)
        columns |= {f"color{c}": rgb[:, k] for k, c in enumerate(("Red", "Green", "Blue"))}
    for key, values in cloud.scalars.items():
        columns[f"tofuse:{key}"] = np.asarray(values, "<f4" if values.dtype.kind == "f" else None)
    with atomic.replacing(path) as temporary:
        file = pye57.E57(str(temporary), mode="w")
        try:
            try:
                _write(file, pye57.libe57, columns, with_normals=cloud.normals is not None)
            finally:
                file.close()
        except pye57.libe57.E57Exception as error:
            file.close = lambda: None  # its destructor would try again, and print that it failed
            reason = str(error).split("\n", 1)[0]
            raise OutputError(
                f"can't be written ({reason})", where=path, remedy="free some space"
            ) from error


def _write(file: Any, lib: Any, columns: Mapping[str, NDArray[Any]], *, with_normals: bool) -> None:
    image = file.image_file
    image.extensionsAdd("tofuse", _TOFUSE)
    if with_normals:
        image.extensionsAdd("nor", _NORMALS)

    def structure(**values: float) -> Any:
        node = lib.StructureNode(image)
        for key, value in values.items():
            is_integer = isinstance(value, int)
            node.set(key, (lib.IntegerNode if is_integer else lib.FloatNode)(image, value))
        return node

    scan = lib.StructureNode(image)
    content = hashlib.md5(usedforsecurity=False)
    for column in columns.values():
        content.update(np.ascontiguousarray(column).tobytes())
    scan.set("guid", lib.StringNode(image, f"{{{uuid.UUID(content.hexdigest())}}}"))
    scan.set("name", lib.StringNode(image, "model"))
    bounds = {}
    for axis in "XYZ":
        column = columns[f"cartesian{axis}"]
        bounds[f"{axis.lower()}Minimum"] = float(column.min())
        bounds[f"{axis.lower()}Maximum"] = float(column.max())
    scan.set("cartesianBounds", structure(**bounds))
    if "colorRed" in columns:
        limits = {
            f"color{channel}{end}": limit
            for channel in ("Red", "Green", "Blue")
            for end, limit in (("Minimum", 0), ("Maximum", 255))
        }
        scan.set("colorLimits", structure(**limits))
    pose = lib.StructureNode(image)
    pose.set("rotation", structure(w=1.0, x=0.0, y=0.0, z=0.0))
    pose.set("translation", structure(x=0.0, y=0.0, z=0.0))
    scan.set("pose", pose)

    prototype = lib.StructureNode(image)
    buffers = lib.VectorSourceDestBuffer()
    count = len(columns["cartesianX"])
    referenced = []  # by the buffers, which do not keep their arrays alive
    for key, column in columns.items():
        # Normals and sigma may be unknown, NaN, which is no limit.
        low, high = np.fmin.reduce(column).item(), np.fmax.reduce(column).item()
        if column.dtype.kind == "f":
            low, high = np.nan_to_num([low, high], posinf=np.inf, neginf=-np.inf).tolist()
            values: NDArray[Any] = np.ascontiguousarray(column)
            precision = lib.E57_DOUBLE if column.dtype == np.float64 else lib.E57_SINGLE
            node = lib.FloatNode(image, low, precision, low, high)
        else:
            # The library takes uint8 and floats, and converts them to the type in the file.
            is_uint8 = column.dtype == np.uint8
            low, high = (0, 255) if is_uint8 else (low, high)
            values = np.ascontiguousarray(column, np.uint8 if is_uint8 else np.float64)
            node = lib.IntegerNode(image, low, low, high)
        prototype.set(key, node)
        referenced.append(values)
        buffers.append(lib.SourceDestBuffer(image, key, values, count, True, True))
    points = lib.CompressedVectorNode(image, prototype, lib.VectorNode(image, True))
    scan.set("points", points)
    file.data3d.append(scan)
    writer = points.writer(buffers)
    writer.write(count)
    writer.close()
