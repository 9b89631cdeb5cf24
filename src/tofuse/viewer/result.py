"""What an output folder holds, gathered for the viewer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Float32, Float64, Int32, UInt8
from tofuse.errors import InputError
from tofuse.files.geometry_record import GeometryRecord
from tofuse.files.glb import read_glb
from tofuse.files.ply import read_ply
from tofuse.files.tileset import Tile, read_tileset
from tofuse.fusion.colors import seen_colors
from tofuse.fusion.mesh import Mesh
from tofuse.fusion.upright import upright
from tofuse.report.fields import OF_95_PERCENT
from tofuse.report.images import viridis
from tofuse.report.pictures import Pictures
from tofuse.report.scene import RigCameras
from tofuse.report.words import length
from tofuse.results.folder import TILES, TILESET, finish_interrupted, is_result
from tofuse.results.output import main_poses, read_run_json
from tofuse.viewer.detail import OVERVIEW_FACES, chosen
from tofuse.viewer.kept import read_kept

MAX_FACES = 500_000  # of a surface that a browser turns smoothly


@dataclass(frozen=True, eq=False)
class Layer:
    """Points, or a surface, and what they can be coloured by.

    Attributes
    ----------
    points, normals
        (N, 3) m, in the world frame; normals may be None.
    faces
        (M, 3) rows of `points`, or None for a cloud.
    color
        (N, 3) RGB from colour or amplitude, or None.
    sigma, views
        (N,) m and counts, or None.
    """

    points: Float32
    normals: Float32 | None
    faces: Int32 | None
    color: UInt8 | None
    sigma: Float64 | None
    views: Float64 | None

    @classmethod
    def of(cls, ply: GeometryRecord) -> Layer:
        """Return the layer of a PLY file that tofuse wrote."""
        scalars = {
            name: ply.scalars[name].astype(float)
            for name in ("sigma", "views")
            if name in ply.scalars
        }
        return cls(
            ply.points.astype(np.float32),
            ply.normals,
            ply.faces,
            ply.color,
            scalars.get("sigma"),
            scalars.get("views"),
        )

    def simplified(self, faces: int) -> Layer:
        """Return a surface with about `faces` triangles at most; of a cloud there is no less."""
        if self.faces is None or self.normals is None or len(self.faces) <= faces:
            return self
        n = len(self.points)
        color = None if self.color is None else seen_colors(self.color)
        sigma = np.zeros(n) if self.sigma is None else self.sigma
        views = np.zeros(n) if self.views is None else self.views
        small = Mesh(
            self.points, self.faces, self.normals, color, sigma.astype(np.float32),
            views.astype(np.int32), np.zeros(3),
        ).decimated(faces)  # fmt: skip
        return Layer(
            small.vertices,
            small.normals,
            small.faces,
            small.color,
            None if self.sigma is None else small.sigma.astype(float),
            None if self.views is None else small.views.astype(float),
        )


@dataclass(frozen=True, eq=False)
class TiledLayer:
    """A surface in tiles, which are read when they are asked for.

    Attributes
    ----------
    folder, root
        Where they are, and their tree.
    R_up_world
        (3, 3) from the world into the axes of the tiles.
    """

    folder: Path
    root: Tile
    R_up_world: Float64

    @classmethod
    def read(cls, folder: Path) -> TiledLayer:
        """Read the tree of a folder; InputError if it is damaged."""
        path = folder / TILESET
        root, extras = read_tileset(path)
        T = np.array(extras.get("T_up_world", np.eye(4)), float)
        if T.shape != (4, 4) or not np.isfinite(T).all():
            raise InputError("has no T_up_world", where=path, remedy="copy the whole folder")
        return cls(folder, root, T[:3, :3])

    def layer(self, tile: Tile) -> Layer:
        """Read a tile that has a file, into the world frame."""
        assert tile.content is not None
        glb = read_glb(self.folder / tile.content)
        R = self.R_up_world.astype(np.float32)
        known = {name: glb.scalars[name].astype(float) for name in glb.scalars}
        return Layer(
            glb.points.astype(np.float32) @ R,
            None if glb.normals is None else glb.normals.astype(np.float32) @ R,
            glb.faces,
            glb.color,
            known.get("sigma"),
            known.get("views"),
        )

    def overview(self) -> Layer:
        """All of it, with few triangles."""
        return joined([self.layer(tile) for tile in chosen(self.root, None, OVERVIEW_FACES)])


def joined(layers: Sequence[Layer]) -> Layer:
    """Put layers with faces into one; it has what all of them have."""

    def column(values: list[NDArray[Any] | None]) -> Any:
        known = [each for each in values if each is not None]
        return np.concatenate(known) if len(known) == len(layers) else None

    firsts = np.cumsum([0] + [len(layer.points) for layer in layers])
    faces = [
        layer.faces + np.int32(first)
        for layer, first in zip(layers, firsts, strict=False)
        if layer.faces is not None
    ]
    return Layer(
        np.concatenate([layer.points for layer in layers]),
        column([layer.normals for layer in layers]),
        np.concatenate(faces),
        column([layer.color for layer in layers]),
        column([layer.sigma for layer in layers]),
        column([layer.views for layer in layers]),
    )


@dataclass(frozen=True, eq=False)
class Result:
    """A result, as the viewer shows it.

    Attributes
    ----------
    run
        `run.json`.
    after, before
        T_world_camera (4, 4) by frame index, with loops closed and before.
    model_before
        Points as they lay before, or None.
    up
        (3,) unit vector in the world.
    tiles
        Of a surface that is too large to be shown at once; `mesh` and `cloud` are an overview then.
    """

    folder: Path
    run: dict[str, Any]
    cloud: Layer
    mesh: Layer | None
    after: dict[int, Float64]
    before: dict[int, Float64]
    model_before: Layer | None
    pictures: tuple[Pictures, ...]
    up: Float64
    tiles: TiledLayer | None = None

    @property
    def frames(self) -> list[dict[str, Any]]:
        """What `run.json` says of each frame."""
        frames: list[dict[str, Any]] = self.run["frames"]
        return frames

    @property
    def rig(self) -> RigCameras | None:
        """The cameras of a rig; None where there is one camera."""
        return RigCameras.of(self.run.get("rig"), len(self.frames))

    @property
    def loops(self) -> Float64:
        """(L, 2, 3) ends of the accepted loops whose frames have a pose."""
        pairs = [(p["i"], p["j"]) for p in self.run["loops"] if p["accepted"]]
        ends = [
            [self.after[i][:3, 3], self.after[j][:3, 3]]
            for i, j in pairs
            if i in self.after and j in self.after
        ]
        return np.array(ends, float).reshape(-1, 2, 3)


def read_result(folder: Path) -> Result:
    """Read the output folder of a run.

    Raises
    ------
    InputError
        If it is no such folder, or what it holds is damaged or of different runs.
    """
    if not folder.exists():
        raise InputError("doesn't exist", where=folder, remedy="give the --out of `tofuse run`")
    finish_interrupted(folder)
    if not folder.is_dir() or not is_result(folder):
        raise InputError(
            "holds no result (no run.json)", where=folder, remedy="give the --out of `tofuse run`"
        )
    run = read_run_json(folder / "run.json")
    posed, poses = main_poses(folder, run)
    after = dict(zip(posed, poses, strict=True))
    tiled = None
    if run.get("tiles"):
        tiled = TiledLayer.read(folder / TILES)
        mesh: Layer | None = tiled.overview()
        cloud = replace(tiled.overview(), faces=None)
    else:
        cloud = Layer.of(read_ply(folder / "cloud.ply"))
        mesh = None
        if (folder / "mesh.ply").is_file():
            mesh = Layer.of(read_ply(folder / "mesh.ply")).simplified(MAX_FACES)
    kept = read_kept(folder)
    model_before = None
    if kept is not None and len(kept.points):
        model_before = Layer(kept.points, None, None, kept.color, None, None)
    return Result(
        folder,
        run,
        cloud,
        mesh,
        after,
        {} if kept is None else kept.before,
        model_before,
        () if kept is None else kept.pictures,
        _up(run, mesh, poses),
        tiled,
    )


def _up(run: dict[str, Any], mesh: Layer | None, poses: Float64) -> Float64:
    if "T_up_world" in run:
        stated: Float64 = np.array(run["T_up_world"], float)[1, :3]
        return stated
    n = 0 if mesh is None else len(mesh.points)
    if mesh is not None and n and mesh.normals is not None and mesh.faces is not None:
        nothing = np.zeros(n, np.int32)
        shape = Mesh(
            mesh.points, mesh.faces, mesh.normals, None, nothing.astype(np.float32), nothing,
            np.zeros(3),
        )  # fmt: skip
        return upright(shape, poses)[1]
    up = -poses[:, :3, 1].mean(0) if len(poses) else np.zeros(3)
    length = float(np.linalg.norm(up))
    return up / length if length > 0.1 else np.array([0.0, -1.0, 0.0])


# What the model can be coloured by.
COLORINGS = ("colour", "height", "accuracy", "view count")


def colorings(layers: Sequence[Layer]) -> list[str]:
    """Return what at least one of the layers can be coloured by."""
    needs: dict[str, list[NDArray[Any] | None]] = {
        "colour": [la.color for la in layers],
        "height": [la.points for la in layers],
        "accuracy": [la.sigma for la in layers],
        "view count": [la.views for la in layers],
    }
    return [name for name in COLORINGS if any(value is not None for value in needs[name])]


@dataclass(frozen=True)
class Bar:
    """A colour bar: what it is of, and what is written at its ends and in its middle."""

    label: str
    ticks: tuple[str, str, str]


def painted(
    layer: Layer, by: str, up: Float64, scale_of: Layer | None = None
) -> tuple[UInt8, Bar | None]:
    """Return colours (N, 3) of a layer, and their bar; grey if it has no such values.

    The scale is that of another layer where one is given, of which this one is a part.

    Colours of values are exactly those of the bar. The layer's own are shaded, from above and from
    one side, as no light of the page changes them.
    """
    if by == "colour" and layer.color is not None:
        return _shaded(seen_colors(layer.color), layer, up), None
    values = _values(layer, by, up)
    if values is not None:
        known = None if scale_of is None else _values(scale_of, by, up)
        return _mapped(values, values if known is None else known, by)
    return np.full((len(layer.points), 3), 170, np.uint8), None


def _values(layer: Layer, by: str, up: Float64) -> Float64 | None:
    """What a layer is coloured by; None if it does not have it."""
    if by == "height":
        return np.asarray(layer.points @ up, np.float64)
    if by == "accuracy" and layer.sigma is not None:
        return np.asarray(OF_95_PERCENT * layer.sigma, np.float64)
    return layer.views if by == "view count" else None


_LABELS: dict[str, tuple[str, Callable[[float], str]]] = {
    "height": ("Height", length),
    "accuracy": ("Accuracy (95 %)", lambda m: f"±{length(m)}"),
    "view count": ("Number of views", lambda n: f"{n:.0f}"),
}


def _mapped(values: Float64, scale: Float64, by: str) -> tuple[UInt8, Bar]:
    """Colours of values on the scale of others, and the bar; accuracies by their ratios."""
    label, say = _LABELS[by]
    ratio = by == "accuracy"
    shown, known = (np.log(np.maximum(v, 1e-6)) if ratio else v for v in (values, scale))
    good = known[np.isfinite(known)]
    low, high = np.percentile(good, [2, 98]).tolist() if len(good) else (0.0, 1.0)
    back: Callable[[float], float] = (lambda v: float(np.exp(v))) if ratio else float
    zero = low if by == "height" else 0.0
    ticks = tuple(say(back(v) - zero) for v in (low, (low + high) / 2, high))
    colors = viridis((np.nan_to_num(shown, nan=high) - low) / max(high - low, 1e-9))
    return colors, Bar(label, (ticks[0], ticks[1], ticks[2]))


def _shaded(color: UInt8, layer: Layer, up: Float64) -> UInt8:
    if layer.normals is None or layer.faces is None:
        return color
    side = np.cross(up, [0.6, 0.0, 0.8])
    side /= max(float(np.linalg.norm(side)), 1e-9)
    light = 0.78 + 0.14 * (layer.normals @ up) + 0.08 * np.abs(layer.normals @ side)
    return (color * light[:, None]).clip(0, 255).astype(np.uint8)
