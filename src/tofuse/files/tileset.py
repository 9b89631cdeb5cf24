"""3D Tiles 1.1 (OGC 22-025r4): a tree of boxes, whose glTF files stand for all below them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.files.atomic import write_text
from tofuse.files.reading import read_bytes

# Tiles have z up; what draws glTF in them turns its y there: (x, y, z) becomes (x, -z, y).
R_TILES_GLTF = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_DEEPEST = 40
_THINNEST_M = 1e-3  # half of a box: some viewers take the inverse of its axes


@dataclass(eq=False)
class Tile:
    """A box of a model.

    Attributes
    ----------
    low, high
        (3,) corners of the box around it and all below, m, in the axes of the glTF files: y up.
    error_m
        How far off it is from the whole model; 0 for what is the model.
    content
        Name of its glTF file beside the tileset; None where it has none.
    faces
        Triangles of its file.
    children
        They take its place where more is to be seen.
    """

    low: Float64
    high: Float64
    error_m: float
    content: str | None
    faces: int
    children: list[Tile] = field(default_factory=list)

    def walk(self) -> Iterator[Tile]:
        """It and all below."""
        yield self
        for child in self.children:
            yield from child.walk()


def write_tileset(path: str | Path, root: Tile, *, generator: str, extras: dict[str, Any]) -> None:
    """Write a tree of tiles; see `replacing` for errors. `extras` are kept as they are."""
    document = {
        "asset": {"version": "1.1", "generator": generator},
        "extras": extras,
        # What is wrong if nothing is drawn.
        "geometricError": float(np.linalg.norm(root.high - root.low)),
        "root": {**_tile(root), "refine": "REPLACE"},
    }
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _tile(tile: Tile) -> dict[str, Any]:
    middle, half = R_TILES_GLTF @ (tile.low + tile.high) / 2, (tile.high - tile.low) / 2
    axes = np.diag(np.maximum(np.abs(R_TILES_GLTF @ half), _THINNEST_M))
    out: dict[str, Any] = {
        "boundingVolume": {"box": [*middle.tolist(), *axes.ravel().tolist()]},
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
        If it can't be read, is damaged, or is no such file.
    """
    try:
        document = json.loads(read_bytes(path))
        if document["asset"]["version"] != "1.1":
            raise ValueError(f"of version {document['asset']['version']}")
        return _read(document["root"], 0), dict(document["extras"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"is no tileset of ours, or damaged ({error})",
            where=path,
            remedy="copy the whole folder, or make it again",
        ) from error


def _read(data: dict[str, Any], depth: int) -> Tile:
    box = np.array(data["boundingVolume"]["box"], float)
    if box.shape != (12,) or not np.isfinite(box).all() or depth > _DEEPEST:
        raise ValueError("a box is wrong")
    middle = R_TILES_GLTF.T @ box[:3]
    half = np.abs(R_TILES_GLTF.T @ box[3:].reshape(3, 3).sum(0))
    content = data["content"]["uri"] if "content" in data else None
    if content is not None and Path(content).name != content:
        raise ValueError(f"{content!r} is not beside it")
    return Tile(
        middle - half,
        middle + half,
        float(data["geometricError"]),
        content,
        int(data["extras"]["faces"]),
        [_read(child, depth + 1) for child in data.get("children", ())],
    )
