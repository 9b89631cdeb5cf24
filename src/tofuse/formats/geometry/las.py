"""LAS 1.4 (ASPRS 2019) and LAZ: clouds, with further columns as extra bytes."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.fusion import GeometryRecord
from tofuse.formats.files import replacing, write_bytes

_HEADER_BYTES, _FIELD_BYTES = 375, 192
_SCALE_M = 1e-4  # rounds by half of that; 31 bits of it span 200 km
_PLAIN, _WITH_COLOR = 6, 7  # point data record formats
_BLOCK_POINTS = 1 << 19  # written to a compressed file at a time
_IS_WKT = 16  # required by the standard for these formats
_TYPES = {"u1": 1, "i1": 2, "u2": 3, "i2": 4, "u4": 5, "i4": 6, "u8": 7, "i8": 8, "f4": 9, "f8": 10}


def write_las(
    path: str | Path,
    cloud: GeometryRecord,
    *,
    descriptions: Mapping[str, str] | None = None,
    software: str = "tofuse",
) -> None:
    """Write points, colours and scalars, to a tenth of a millimetre, without georeference.

    Parameters
    ----------
    path
        The file; see `replacing` for errors.
    cloud
        Its scalars keep their types.
    descriptions
        Of scalars, by name; names and descriptions are cut to 32 characters.
    software
        The writing program, as the header states it.

    Raises
    ------
    InputError
        If the shapes disagree.
    """
    cloud.check(path)
    xyz = np.asarray(cloud.points, np.float64)
    color, extra = cloud.color, cloud.scalars
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
    rows["returns"] = 1 | 1 << 4  # return 1 of 1
    if color is not None:
        rows["color"] = np.asarray(color, np.uint16) * 257
    for name, values in extra.items():
        rows[f"extra {name}"] = values
    records = b""
    if extra:
        texts = descriptions or {}
        fields = b"".join(_field(name, v, texts.get(name, "")) for name, v in extra.items())
        records = (
            struct.pack("<H16sHH32s", 0, b"LASF_Spec", 4, len(fields), b"Extra Bytes") + fields
        )
    low, high = (xyz.min(0), xyz.max(0)) if len(xyz) else (np.zeros(3), np.zeros(3))
    header = struct.pack(
        "<4sHHIHH8sBB32s32sHHHIIBHI5I12dQQIQ15Q",
        b"LASF", 0, _IS_WKT, 0, 0, 0, b"", 1, 4, b"", software.encode()[:32], 0, 0, _HEADER_BYTES,
        _HEADER_BYTES + len(records), 1 if records else 0,
        _PLAIN if color is None else _WITH_COLOR, rows.itemsize, 0, 0, 0, 0, 0, 0,
        *[_SCALE_M] * 3, *offset, high[0], low[0], high[1], low[1], high[2], low[2],
        0, 0, 0, len(rows), len(rows), *[0] * 14,
    )  # fmt: skip
    write_bytes(path, header + records + rows.tobytes())


def write_laz(
    path: str | Path,
    cloud: GeometryRecord,
    *,
    descriptions: Mapping[str, str] | None = None,
    software: str = "tofuse",
) -> None:
    """Write the content of `write_las`, compressed (Isenburg 2013), block by block.

    Raises
    ------
    InputError
        If the shapes disagree.
    """
    import laspy

    cloud.check(path)
    xyz, color, extra = cloud.points, cloud.color, cloud.scalars
    header = laspy.LasHeader(point_format=_PLAIN if color is None else _WITH_COLOR, version="1.4")
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.floor(xyz.mean(0, dtype=float)) if len(xyz) else np.zeros(3)
    header.generating_software = software[:32]
    header.system_identifier = ""
    header.creation_date = None  # the bytes must not depend on the day
    header.global_encoding.wkt = True
    texts = descriptions or {}
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name, values.dtype, texts.get(name, "")[:32])
            for name, values in extra.items()
        ]
    )
    backend = laspy.LazBackend.Lazrs  # single-threaded: with several, the order of chunks varies
    with (
        replacing(path) as temporary,
        temporary.open("wb") as file,
        laspy.open(
            file, mode="w", header=header, do_compress=True, laz_backend=backend, closefd=False
        ) as writer,
    ):
        for start in range(0, len(xyz), _BLOCK_POINTS):
            block = slice(start, min(start + _BLOCK_POINTS, len(xyz)))
            rows = laspy.ScaleAwarePointRecord.zeros(block.stop - start, header=header)
            rows["X"], rows["Y"], rows["Z"] = (
                np.round((xyz[block] - header.offsets) / _SCALE_M).astype(np.int32).T
            )
            rows["return_number"] = rows["number_of_returns"] = np.ones(len(rows), np.uint8)
            if color is not None:
                for k, name in enumerate(("red", "green", "blue")):
                    rows[name] = color[block, k].astype(np.uint16) * np.uint16(257)
            for name, values in extra.items():
                rows[name] = values[block]
            writer.write_points(rows)


def _column(name: str, kind: Any) -> tuple[Any, ...]:
    return (name, *kind) if isinstance(kind, tuple) else (name, kind)


def _field(name: str, values: NDArray[Any], description: str) -> bytes:
    """The descriptor of a column of extra bytes."""
    code = _TYPES[f"{values.dtype.kind}{values.dtype.itemsize}"]
    start = struct.pack("<HBB32s", 0, code, 0, name.encode()[:32])
    padding = b"\0" * (_FIELD_BYTES - len(start) - 32)
    return start + padding + struct.pack("32s", description.encode()[:32])
