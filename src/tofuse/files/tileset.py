"""3D Tiles 1.1 (OGC 22-025r4): a tree of boxes with glTF files at several levels of detail."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.arrays import Float64
from tofuse.files.atomic import write_text
from tofuse.files.reading import damage_reported, read_bytes

# Tiles have z up; renderers rotate the y axis of glTF there: (x, y, z) becomes (x, -z, y).
R_TILES_GLTF = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_MAX_DEPTH = 40
_MIN_HALF_M = 1e-3  # half the size of a box: some viewers invert its axes


@dataclass(eq=False)
class Tile:
    """A node of the tree.

    Attributes
    ----------
    low, high
        (3,) corners in m of the bounding box, including all children, in glTF axes: y up.
    error_m
        Geometric error in m relative to the full model; 0 at the leaves.
    content
        Name of its glTF file in the folder of the tileset; None if it has none.
    faces
        Triangles of its file.
    children
        Tiles that replace it at higher detail.
    """

    low: Float64
    high: Float64
    error_m: float
    content: str | None
    faces: int
    children: list[Tile] = field(default_factory=list)

    def walk(self) -> Iterator[Tile]:
        """Yield this tile and all below it."""
        yield self
        for child in self.children:
            yield from child.walk()


def write_tileset(path: str | Path, root: Tile, *, generator: str, extras: dict[str, Any]) -> None:
    """Write a tree of tiles; see `replacing` for errors.

    Parameters
    ----------
    path
        The tileset.json.
    root
        The tree.
    generator
        The writing program, as the file states it.
    extras
        JSON data to store with it.
    """
    document = {
        "asset": {"version": "1.1", "generator": generator},
        "extras": extras,
        # The error if nothing is rendered.
        "geometricError": float(np.linalg.norm(root.high - root.low)),
        "root": {**_tile(root), "refine": "REPLACE"},
    }
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _tile(tile: Tile) -> dict[str, Any]:
    centre, half = R_TILES_GLTF @ (tile.low + tile.high) / 2, (tile.high - tile.low) / 2
    axes = np.diag(np.maximum(np.abs(R_TILES_GLTF @ half), _MIN_HALF_M))
    out: dict[str, Any] = {
        "boundingVolume": {"box": [*centre.tolist(), *axes.ravel().tolist()]},
        "geometricError": tile.error_m,
        "extras": {"faces": tile.faces},
    }
    if tile.content is not None:
        out["content"] = {"uri": tile.content}
    if tile.children:
        out["children"] = [_tile(child) for child in tile.children]
    return out


def read_tileset(path: str | Path) -> tuple[Tile, dict[str, Any]]:
    """Read a tree that `write_tileset` wrote, and its extras.

    Raises
    ------
    InputError
        If it can't be read, is damaged, or was written by another program.
    """
    with damage_reported(path, "a tileset"):
        document = json.loads(read_bytes(path))
        if document["asset"]["version"] != "1.1":
            raise ValueError(f"version {document['asset']['version']}")
        return _read(document["root"], 0), dict(document["extras"])


def _read(data: dict[str, Any], depth: int) -> Tile:
    box = np.array(data["boundingVolume"]["box"], float)
    if box.shape != (12,) or not np.isfinite(box).all() or depth > _MAX_DEPTH:
        raise ValueError("invalid bounding box")
    centre = R_TILES_GLTF.T @ box[:3]
    half = np.abs(R_TILES_GLTF.T @ box[3:].reshape(3, 3).sum(0))
    content = data["content"]["uri"] if "content" in data else None
    if content is not None and Path(content).name != content:
        raise ValueError(f"{content!r} is not in its folder")
    return Tile(
        centre - half,
        centre + half,
        float(data["geometricError"]),
        content,
        int(data["extras"]["faces"]),
        [_read(child, depth + 1) for child in data.get("children", ())],
    )
