"""The content of an output folder for the viewer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Float64, UInt8
from tofuse.errors import InputError
from tofuse.files.geometry_record import GeometryRecord
from tofuse.files.glb import read_glb
from tofuse.files.ply import read_ply
from tofuse.files.tileset import Tile, read_tileset
from tofuse.fusion.colors import display_colors
from tofuse.fusion.mesh import mesh_of
from tofuse.normal import OF_95_PERCENT
from tofuse.report import fields
from tofuse.report.fields import Field
from tofuse.report.scene import RigCameras
from tofuse.report.thumbnails import viridis
from tofuse.results.folder import TILES, TILESET, finish_interrupted, is_result
from tofuse.results.run_json import (
    main_poses,
    read_run_json,
    rotation_up_world,
    run_json_checked,
)
from tofuse.viewer.level_of_detail import OVERVIEW_FACES, select_tiles
from tofuse.viewer.view_file import ViewFile, read_view_file

MAX_FACES = 500_000  # that a browser renders smoothly


@dataclass(frozen=True, eq=False)
class TiledLayer:
    """A surface in tiles, which are read on demand.

    Attributes
    ----------
    folder, root
        The folder of the tiles, and the root of their tree.
    R_up_world
        (3, 3) from the world into the axes of the tiles.
    """

    folder: Path
    root: Tile
    R_up_world: Float64

    @classmethod
    def read(cls, folder: Path) -> TiledLayer:
        """Read the tree of tiles in a folder; InputError if it is damaged."""
        path = folder / TILESET
        root, extras = read_tileset(path)
        return cls(folder, root, rotation_up_world(extras, path))

    def layer(self, tile: Tile) -> GeometryRecord:
        """Read a tile with content, in the world frame."""
        assert tile.content is not None
        glb = read_glb(self.folder / tile.content)
        R = self.R_up_world.astype(np.float32)
        normals = None if glb.normals is None else glb.normals @ R
        return replace(glb, points=glb.points @ R, normals=normals)

    def overview(self) -> GeometryRecord:
        """The full surface with few triangles; InputError if tiles are missing or damaged."""
        layers = [self.layer(tile) for tile in select_tiles(self.root, None, OVERVIEW_FACES)]
        if not layers:
            raise InputError(
                "has no tiles", where=self.folder / TILESET, remedy="copy the whole folder"
            )
        return merged(layers)


def merged(layers: Sequence[GeometryRecord]) -> GeometryRecord:
    """Merge surfaces; the result has the columns that all of them have."""

    def joined(columns: list[NDArray[Any] | None]) -> Any:
        present = [column for column in columns if column is not None]
        return np.concatenate(present) if len(present) == len(layers) else None

    offsets = np.cumsum([0] + [len(layer) for layer in layers])
    faces = [
        layer.faces + np.int32(offset)
        for layer, offset in zip(layers, offsets, strict=False)
        if layer.faces is not None
    ]
    return GeometryRecord(
        np.concatenate([layer.points for layer in layers]),
        np.concatenate(faces),
        joined([layer.normals for layer in layers]),
        joined([layer.color for layer in layers]),
        scalars={
            name: np.concatenate([layer.scalars[name] for layer in layers])
            for name in layers[0].scalars
            if all(name in layer.scalars for layer in layers)
        },
    )


@dataclass(frozen=True, eq=False)
class ViewContent:
    """The content of a result in the viewer.

    Attributes
    ----------
    folder, run
        The output folder and its `run.json`.
    cloud, mesh
        The model, with the columns `sigma` (m) and `views` where they are known.
    after
        T_world_camera (4, 4) by frame index, after loop closure.
    view
        Its `view.npz`.
    up
        (3,) unit vector in the world frame.
    tiles
        The tiles of a large surface, of which `mesh` and `cloud` are an overview; else None.
    """

    folder: Path
    run: dict[str, Any]
    cloud: GeometryRecord
    mesh: GeometryRecord | None
    after: dict[int, Float64]
    view: ViewFile
    up: Float64
    tiles: TiledLayer | None = None

    @property
    def frames(self) -> list[dict[str, Any]]:
        """The entries of `run.json` for the frames."""
        frames: list[dict[str, Any]] = self.run["frames"]
        return frames

    @property
    def rig(self) -> RigCameras | None:
        """The cameras of a rig; None for a single camera."""
        return RigCameras.of(self.run.get("rig"), len(self.frames))

    @property
    def loops(self) -> Float64:
        """(L, 2, 3) camera centres of accepted loop closures, m."""
        pairs = [(p["i"], p["j"]) for p in self.run["loops"] if p["accepted"]]
        ends = [
            [self.after[i][:3, 3], self.after[j][:3, 3]]
            for i, j in pairs
            if i in self.after and j in self.after
        ]
        return np.array(ends, float).reshape(-1, 2, 3)


def read_content(folder: Path) -> ViewContent:
    """Read the output folder of a run for the viewer.

    Raises
    ------
    InputError
        If it is not an output folder, or its files are damaged or of different runs.
    """
    finish_interrupted(folder)
    if not folder.exists():
        raise InputError("doesn't exist", where=folder, remedy="pass the --out of `tofuse run`")
    if not folder.is_dir() or not is_result(folder):
        raise InputError(
            "is not a result (no run.json)", where=folder, remedy="pass the --out of `tofuse run`"
        )
    run = read_run_json(folder / "run.json")
    posed, poses = main_poses(folder, run)
    tiled = None
    mesh: GeometryRecord | None = None
    if run.get("tiles"):
        tiled = TiledLayer.read(folder / TILES)
        mesh = tiled.overview()
        cloud = replace(mesh, faces=None)
    else:
        cloud = read_ply(folder / "cloud.ply")
        if (folder / "mesh.ply").is_file():
            mesh = _simplified(read_ply(folder / "mesh.ply"))
    content = ViewContent(
        folder,
        run,
        cloud,
        mesh,
        dict(zip(posed, poses, strict=True)),
        read_view_file(folder),
        rotation_up_world(run, folder / "run.json")[1],
        tiled,
    )
    with run_json_checked(folder / "run.json"):
        _check_fields(content)
    return content


def _simplified(surface: GeometryRecord) -> GeometryRecord:
    """A surface simplified to the number of triangles that a browser renders smoothly."""
    if surface.faces is None or len(surface.faces) <= MAX_FACES:
        return surface
    color = None if surface.color is None else display_colors(surface.color)
    return mesh_of(replace(surface, color=color)).clustered(MAX_FACES).record()


def _check_fields(content: ViewContent) -> None:
    """Read the fields that the viewer shows; KeyError, TypeError or similar if one is damaged."""
    for frame in content.frames:
        int(frame["index"]), str(frame["status"]), str(frame["reason"])
    for reason in content.run["reasons"]:
        str(reason["text"])
    len(content.run["components"]), str(content.run["verdict"]), content.loops, content.rig


# Values by which the model can be coloured.
COLORINGS = ("colour", "height", "accuracy", "view count")


def colorings(layers: Sequence[GeometryRecord]) -> list[str]:
    """Return the colourings that at least one of the layers has values for."""
    values: dict[str, list[NDArray[Any] | None]] = {
        "colour": [la.color for la in layers],
        "height": [la.points for la in layers],
        "accuracy": [la.scalars.get("sigma") for la in layers],
        "view count": [la.scalars.get("views") for la in layers],
    }
    return [name for name in COLORINGS if any(value is not None for value in values[name])]


def layer_colors(
    layer: GeometryRecord, coloring: str, up: Float64, scale_of: GeometryRecord | None = None
) -> tuple[UInt8, Field | None]:
    """Return colours (N, 3) of a layer, and the field of the bar; grey if it has no such values.

    Colours of values are exactly those of the bar. The layer's original colours are shaded by a
    fixed light from above and from one side, since the page is unlit.

    Parameters
    ----------
    layer
        The layer.
    coloring
        One of `COLORINGS`.
    up
        (3,) unit vector in the world frame.
    scale_of
        The layer whose range of values defines the scale; by default the same layer.
    """
    if coloring == "colour" and layer.color is not None:
        return _shaded(display_colors(layer.color), layer, up), None
    values = _values(layer, coloring, up)
    if values is None:
        return np.full((len(layer.points), 3), 170, np.uint8), None
    scale_values = None if scale_of is None else _values(scale_of, coloring, up)
    field = _FIELDS[coloring](values if scale_values is None else scale_values)
    return viridis(field.on_bar(values)), field


def _values(layer: GeometryRecord, coloring: str, up: Float64) -> Float64 | None:
    """The values of a layer for a colouring; None if it has none."""
    if coloring == "height":
        return np.asarray(layer.points @ up, np.float64)
    column = layer.scalars.get({"accuracy": "sigma", "view count": "views"}.get(coloring, ""))
    if column is None:
        return None
    return (OF_95_PERCENT if coloring == "accuracy" else 1.0) * column.astype(float)


_FIELDS: dict[str, Callable[[Float64], Field]] = {
    "height": fields.height,
    "accuracy": fields.accuracy,
    "view count": fields.view_count,
}


def _shaded(color: UInt8, layer: GeometryRecord, up: Float64) -> UInt8:
    if layer.normals is None or layer.faces is None:
        return color
    side = np.cross(up, [0.6, 0.0, 0.8])
    side /= max(float(np.linalg.norm(side)), 1e-9)
    light = 0.78 + 0.14 * (layer.normals @ up) + 0.08 * np.abs(layer.normals @ side)
    return (color * light[:, None]).clip(0, 255).astype(np.uint8)
