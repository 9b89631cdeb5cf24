"""`view.npz`: data of the viewer that is in no other file of a result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Float32, Float64, UInt8
from tofuse.errors import InputError
from tofuse.files.geometry_record import GeometryRecord
from tofuse.files.memory import trim_memory
from tofuse.files.npz import read_npz
from tofuse.report.extras import ReportExtras
from tofuse.report.html import write_report
from tofuse.report.pictures import KINDS, Pictures, draw
from tofuse.results.types import Reconstruction

NAME = "view.npz"
_POINTS = 60_000  # of the model before loop closure


@dataclass(frozen=True, eq=False)
class ViewFile:
    """The content of `view.npz`.

    Attributes
    ----------
    before
        T_world_camera (4, 4) before loop closure, by frame index.
    model_before
        Points of the model before loop closure, subsampled; None where optimisation changed
        nothing.
    pictures
        Images of some frames.
    """

    before: dict[int, Float64] = field(default_factory=dict)
    model_before: GeometryRecord | None = None
    pictures: tuple[Pictures, ...] = ()


def write_report_and_view(result: Reconstruction, folder: Path, extras: ReportExtras) -> None:
    """Write `report.html` and `view.npz` of a result.

    Parameters
    ----------
    result
        The result.
    folder
        Output folder.
    extras
        Further content of the report; the images of the result's samples are added to it.

    Raises
    ------
    OutputError, OSError
        If a file can't be written.
    """
    pictures = draw(result.diagnostics.samples)
    trim_memory()
    write_report(result, folder / "report.html", replace(extras, pictures=pictures))
    write_view_file(result, pictures, folder / NAME)


def write_view_file(result: Reconstruction, pictures: Sequence[Pictures], path: Path) -> None:
    """Write `view.npz`; the same result gives the same bytes.

    Parameters
    ----------
    result
        The result.
    pictures
        Images of some frames.
    path
        The file.

    Raises
    ------
    OSError
        If the file can't be written.
    """
    d = result.diagnostics
    index = np.array([r.index for r in d.frames], np.int64)
    posed = np.isfinite(d.sequential).all((1, 2)) if len(index) == len(d.sequential) else None
    points, color = _model_before(result)
    arrays: dict[str, NDArray[np.generic]] = {
        "index": index[:0] if posed is None else index[posed],
        "before": d.sequential[:0] if posed is None else d.sequential[posed],
        "points": points,
        "color": color,
        "picture": np.array([p.index for p in pictures], np.int64),
    }
    for kind in KINDS:
        files = [p.images.get(kind, b"") for p in pictures]
        arrays[f"{kind}_image"] = np.frombuffer(b"".join(files), np.uint8)
        arrays[f"{kind}_size"] = np.array([len(f) for f in files], np.int64)
    with path.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _model_before(result: Reconstruction) -> tuple[Float32, UInt8]:
    cloud = result.diagnostics.cloud_before
    if cloud is None or len(cloud) == 0:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    step = -(-len(cloud) // _POINTS)
    points = (cloud.points[::step] + cloud.offset).astype(np.float32)
    finite = np.isfinite(points).all(1)
    grey = np.full((len(points), 3), 170, np.uint8)
    return points[finite], (grey if cloud.color is None else cloud.color[::step])[finite]


def read_view_file(folder: Path) -> ViewFile:
    """Read `view.npz` of a result; empty where there is none.

    Raises
    ------
    InputError
        If it is damaged.
    """
    path = folder / NAME
    if not path.is_file():
        return ViewFile()
    data = read_npz(path)
    try:
        index, before = data["index"].tolist(), data["before"].astype(float)
        points, color = data["points"].astype(np.float32), data["color"].astype(np.uint8)
        frames = data["picture"].tolist()
        images: list[dict[str, bytes]] = [{} for _ in frames]
        for kind in KINDS:
            joined, start = data[f"{kind}_image"].tobytes(), 0
            for k, size in enumerate(data[f"{kind}_size"].tolist()):
                if size:
                    images[k][kind] = joined[start : start + size]
                start += size
        if before.shape != (len(index), 4, 4) or points.shape != color.shape:
            raise ValueError("its arrays have inconsistent shapes")
        if points.shape != (len(points), 3):
            raise ValueError("its points are not (N, 3)")
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise InputError(
            f"can't be read ({error})", where=path, remedy="remove it, or run again"
        ) from error
    pictures = tuple(
        Pictures(k, frame_images) for k, frame_images in zip(frames, images, strict=True)
    )
    model_before = GeometryRecord(points, color=color) if len(points) else None
    return ViewFile(dict(zip(index, before, strict=True)), model_before, pictures)
