"""LAS 1.4 (ASPRS 2019), and LAZ: clouds, with more values of each point as extra bytes."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.errors import InputError
from tofuse.files.atomic import replacing, write_bytes

_HEADER, _RECORD_HEADER, _FIELD = 375, 54, 192
_SCALE_M = 1e-4  # half a tenth of a millimetre is lost; 2^31 of them reach 200 km
_PLAIN, _WITH_COLOR = 6, 7  # formats of points
_AT_ONCE = 1 << 19  # points of a compressed file that are packed at a time
_IS_WKT = 16  # asked for by the standard, for these formats
_TYPES = {"u1": 1, "i1": 2, "u2": 3, "i2": 4, "u4": 5, "i4": 6, "u8": 7, "i8": 8, "f4": 9, "f8": 10}


def write_las(
    path: str | Path,
    points: ArrayLike,
    *,
    color: ArrayLike | None = None,
    scalars: Mapping[str, tuple[ArrayLike, str]] | None = None,
    software: str = "tofuse",
) -> None:
    """Write a cloud, to a tenth of a millimetre, without a reference to the Earth.

    Parameters
    ----------
    path
        The file; see `replacing` for errors.
    points
        (N, 3) in m.
    color
        (N, 3) uint8 RGB.
    scalars
        More (N,) columns by name, each with a description; their types are kept. At most 32
        characters count of either.
    """
    xyz = np.asarray(points, np.float64).reshape(-1, 3)
    extra = {name: np.asarray(values) for name, (values, _) in (scalars or {}).items()}
    columns: list[tuple[str, Any]] = [
        ("xyz", ("<i4", (3,))), ("intensity", "<u2"), ("returns", "u1"), ("flags", "u1"),
        ("class", "u1"), ("user", "u1"), ("angle", "<i2"), ("source", "<u2"), ("time", "<f8"),
    ]  # fmt: skip
    if color is not None:
        columns.append(("color", ("<u2", (3,))))
    columns += [(f"extra {name}", values.dtype.newbyteorder("<")) for name, values in extra.items()]
    rows = np.zeros(len(xyz), [_column(name, kind) for name, kind in columns])
    offset = np.floor(xyz.mean(0)) if len(xyz) else np.zeros(3)
    rows["xyz"] = np.round((xyz - offset) / _SCALE_M)
    rows["returns"] = 1 | 1 << 4  # the first of one
    if color is not None:
        rows["color"] = np.asarray(color, np.uint16) * 257
    for name, values in extra.items():
        rows[f"extra {name}"] = values
    records = b""
    if scalars:
        fields = b"".join(_field(name, extra[name], words) for name, (_, words) in scalars.items())
        records = (
            struct.pack("<H16sHH32s", 0, b"LASF_Spec", 4, len(fields), b"Extra Bytes") + fields
        )
    low, high = (xyz.min(0), xyz.max(0)) if len(xyz) else (np.zeros(3), np.zeros(3))
    header = struct.pack(
        "<4sHHIHH8sBB32s32sHHHIIBHI5I12dQQIQ15Q",
        b"LASF", 0, _IS_WKT, 0, 0, 0, b"", 1, 4, b"", software.encode()[:32], 0, 0, _HEADER,
        _HEADER + len(records), 1 if records else 0,
        _PLAIN if color is None else _WITH_COLOR, rows.itemsize, 0, 0, 0, 0, 0, 0,
        *[_SCALE_M] * 3, *offset, high[0], low[0], high[1], low[1], high[2], low[2],
        0, 0, 0, len(rows), len(rows), *[0] * 14,
    )  # fmt: skip
    write_bytes(path, header + records + rows.tobytes())


def write_laz(
    path: str | Path,
    points: ArrayLike,
    *,
    color: ArrayLike | None = None,
    scalars: Mapping[str, tuple[ArrayLike, str]] | None = None,
    software: str = "tofuse",
) -> None:
    """Write what `write_las` writes, compressed (Isenburg 2013), a part at a time.

    Raises
    ------
    InputError
        If laspy or lazrs is not installed.
    """
    try:
        import laspy
        import lazrs  # noqa: F401 - laspy compresses by it
    except ImportError as error:
        raise InputError(
            "needs laspy and lazrs, which are not installed",
            where=path,
            remedy="pip install 'tofuse[scan]', or write .las",
        ) from error
    xyz = np.asarray(points).reshape(-1, 3)
    header = laspy.LasHeader(point_format=_PLAIN if color is None else _WITH_COLOR, version="1.4")
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.floor(xyz.mean(0, dtype=float)) if len(xyz) else np.zeros(3)
    header.generating_software = software[:32]
    header.system_identifier = ""
    header.creation_date = None  # the same cloud gives the same bytes on any day
    header.global_encoding.wkt = True
    extra = {name: np.asarray(values) for name, (values, _) in (scalars or {}).items()}
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name, values.dtype, (scalars or {})[name][1][:32])
            for name, values in extra.items()
        ]
    )
    light = None if color is None else np.asarray(color)
    backend = laspy.LazBackend.Lazrs  # on one thread: chunks of several come in any order
    with (
        replacing(path) as beside,
        beside.open("wb") as file,
        laspy.open(
            file, mode="w", header=header, do_compress=True, laz_backend=backend, closefd=False
        ) as writer,
    ):
        for start in range(0, len(xyz), _AT_ONCE):
            part = slice(start, min(start + _AT_ONCE, len(xyz)))
            rows = laspy.ScaleAwarePointRecord.zeros(part.stop - start, header=header)
            rows["X"], rows["Y"], rows["Z"] = (
                np.round((xyz[part] - header.offsets) / _SCALE_M).astype(np.int32).T
            )
            rows["return_number"] = rows["number_of_returns"] = np.ones(len(rows), np.uint8)
            if light is not None:
                for k, name in enumerate(("red", "green", "blue")):
                    rows[name] = light[part, k].astype(np.uint16) * np.uint16(257)
            for name, values in extra.items():
                rows[name] = values[part]
            writer.write_points(rows)


def _column(name: str, kind: Any) -> tuple[Any, ...]:
    return (name, *kind) if isinstance(kind, tuple) else (name, kind)


def _field(name: str, values: NDArray[Any], words: str) -> bytes:
    """Say what a column of extra bytes is."""
    code = _TYPES[f"{values.dtype.kind}{values.dtype.itemsize}"]
    start = struct.pack("<HBB32s", 0, code, 0, name.encode()[:32])
    return start + b"\0" * (_FIELD - len(start) - 32) + struct.pack("32s", words.encode()[:32])
