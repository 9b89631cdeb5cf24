"""LAS 1.4 (ASPRS 2019) and LAZ: clouds, with further columns as extra bytes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tofuse.engine.fusion import GeometryRecord
from tofuse.formats.files import atomic

_SCALE_M = 1e-4  # rounds by half of that; 31 bits of it span 200 km
_PLAIN, _WITH_COLOR = 6, 7  # point data record formats
_BLOCK_POINTS = 1 << 19  # written at a time


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
        The file, compressed (Isenburg 2013) if its name ends in .laz; see `replacing` for errors.
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
    compressed = Path(path).suffix.lower() == ".laz"
    backend = laspy.LazBackend.Lazrs  # single-threaded: with several, the order of chunks varies
    with (
        atomic.replacing(path) as temporary,
        temporary.open("wb") as file,
        laspy.open(
            file,
            mode="w",
            header=header,
            do_compress=compressed,
            laz_backend=backend,
            closefd=False,
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
