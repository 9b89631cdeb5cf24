"""Writes the files of an output folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tofuse._version import __version__
from tofuse.apps.results.folders import OutputFolder, component_name
from tofuse.apps.results.run_json import write_run_json
from tofuse.engine.arrays import Float64, UInt8
from tofuse.engine.compute import job_pool
from tofuse.engine.fusion import GeometryRecord, Mesh, Textured, drawing, texture
from tofuse.engine.geometry import se3
from tofuse.engine.results import Reconstruction
from tofuse.engine.stopwatch import timing
from tofuse.formats.export import exchange
from tofuse.formats.geometry import write_glb, write_ply
from tofuse.formats.images import jpeg_bytes
from tofuse.formats.poses import write_g2o, write_tum

# Colours of surfaces that changed between sessions, distinguishable by colour-blind people.
CHANGE_COLORS = {"appeared": (230, 97, 0), "vanished": (93, 58, 155)}

# Of a simplified surface whose texture is made of the colours of its vertices.
DISPLAY_FACES, TEXTURE_SIZE = 60_000, 2048
QUALITY = 88  # of a texture as JPEG
Report = Callable[[Reconstruction, Path], None]
MAX_PLY_POINTS = 4_000_000  # a larger cloud is compressed


def write_result(
    result: Reconstruction,
    folder: OutputFolder,
    report: Report | None = None,
    texture: Textured | None = None,
    share: bool = False,
) -> None:
    """Write all files of a result.

    Components that are not connected to the main one but have their own model are written to
    `component-1` and so on, by their numbers.

    Parameters
    ----------
    result
        The result.
    folder
        The output folder; existing files are replaced together, when all new ones are complete.
    report
        Writes the report of a result into a folder; None: no report.
    texture
        Texture of the main model, for `mesh.glb`.
    share
        Whether to write `share.usdz` as well.

    Raises
    ------
    OutputError
        If a file can't be written; existing files are unchanged then.
    """
    with folder.staging() as staging:
        for number, component in enumerate(result.components):
            if component.result is not None and not component.connected:
                component_folder = staging / component_name(number)
                component_folder.mkdir()
                _write_files(component.result, component_folder, report, None)
        _write_files(result, staging, report, texture)
        if share and result.mesh is not None and len(result.mesh.faces):
            record = display_record(result.mesh) if texture is None else textured_record(texture)
            exchange.save(record, staging / "share.usdz", result.T_up_world[:3, :3])


def _write_files(
    result: Reconstruction, folder: Path, report: Report | None, texture: Textured | None
) -> None:
    # Both release the interpreter lock for much of their time.
    with job_pool(1, "tofuse-writer") as background:
        model = background.submit(_write_model, result, folder)
        posed = result.has_pose
        poses = se3.about(result.shift, result.trajectory[posed])
        write_tum(folder / "trajectory.txt", result.timestamps[posed], poses)
        write_g2o(folder / "pose_graph.g2o", result.graph)
        if report is not None:
            report(result, folder)
        model.result()
        # Last, since it shares the report's overview of the surface.
        if result.mesh is not None:
            _write_scene(result.mesh, result.T_up_world, folder, texture)
        with timing("writing"):  # its times are those until here
            write_run_json(folder / "run.json", result)


def _write_model(result: Reconstruction, folder: Path) -> None:
    """Write cloud and surface, in the world frame."""
    # In the coordinates of the input's files, also where float32 doesn't hold them.
    cloud = _without_black(result.cloud.record()).shifted(result.shift)
    if len(result.cloud) > MAX_PLY_POINTS:
        exchange.save(cloud, folder / "cloud.laz")
    else:
        write_ply(folder / "cloud.ply", cloud)
    if result.mesh is not None:
        write_ply(folder / "mesh.ply", _without_black(result.mesh.record()))
    if result.changes:
        _write_changes(result, folder / "changes.ply")
    if result.mirrors:
        points = [m.points for m in result.mirrors]
        number = np.repeat(np.arange(len(points), dtype=np.int32), [len(p) for p in points])
        record = GeometryRecord(np.concatenate(points), scalars={"mirror": number})
        write_ply(folder / "mirrors.ply", record.shifted(result.shift))


def _without_black(record: GeometryRecord) -> GeometryRecord:
    """Return a model with a neutral grey where no colour image shows it.

    Black amplitudes are measured ones.
    """
    if record.color is None or (record.color == record.color[:, :1]).all():
        return record
    return replace(record, color=drawing.display_colors(record.color))


def _write_changes(result: Reconstruction, path: Path) -> None:
    """Write the surfaces that changed between sessions, in the colours of `CHANGE_COLORS`."""
    changes = [c.change for c in result.changes]
    counts = [len(change.points) for change in changes]
    colors = np.array([CHANGE_COLORS[change.kind] for change in changes], np.uint8)
    write_ply(
        path,
        GeometryRecord(
            np.concatenate([change.points for change in changes]).astype(np.float32),
            color=np.repeat(colors, counts, axis=0),
            scalars={"change": np.repeat(np.arange(len(changes), dtype=np.int32), counts)},
        ),
    )


def _write_scene(mesh: Mesh, T_up_world: Float64, folder: Path, texture: Textured | None) -> None:
    """Write `mesh.glb`, made upright by its node: the overview of the surface, or its texture."""
    node: dict[str, Any] = {"generator": f"tofuse {__version__}", "T_scene_node": T_up_world}
    if texture is None:
        displayed = mesh.overview
        write_glb(
            folder / "mesh.glb",
            GeometryRecord(
                displayed.vertices,
                displayed.faces,
                normals=displayed.normals,
                color=None if displayed.color is None else drawing.display_colors(displayed.color),
            ),
            **node,
        )
        return
    write_glb(folder / "mesh.glb", textured_record(texture), **node)


def display_record(mesh: Mesh) -> GeometryRecord:
    """Return a simplified surface with the colours of its vertices in a texture."""
    if mesh.color is None:
        mesh = replace(mesh, color=np.zeros_like(mesh.vertices, np.uint8))
    return textured_record(texture.baked(mesh, DISPLAY_FACES, TEXTURE_SIZE))


def textured_record(texture: Textured, jpeg: bytes | None = None) -> GeometryRecord:
    """Return a surface with its texture as a JPEG, in the world frame."""
    shown = texture.charts
    return GeometryRecord(
        shown.vertices,
        shown.faces,
        normals=shown.normals,
        uv=texture.atlas.uv,
        texture=jpeg or jpeg_bytes(texture.image, QUALITY),
    )


def viridis(value: Float64) -> UInt8:
    """Return viridis colours (..., 3) of values from 0 to 1: near is dark, far is bright."""
    return _ramp()[np.round(255 * np.clip(np.nan_to_num(value), 0, 1)).astype(np.intp)]


@cache
def _ramp() -> UInt8:
    """The 256 colours of the map, (256, 3) RGB."""
    import cv2

    levels = np.arange(256, dtype=np.uint8)[:, None]
    return np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[:, 0, ::-1], np.uint8)
