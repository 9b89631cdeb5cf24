"""Geometric error of mesh decimation, by vertex clustering and by edge collapse.

Each result folder's `mesh.ply` is reduced to the same number of triangles by `Mesh.clustered`, by
`Mesh.decimated` (quadric edge collapse, by fast-simplification), and, if it is installed, by Open3D
(the same, with a priority queue). Printed are the mean, 99th percentile and maximum of the
distances in mm between 400,000 points of one surface and the other, in both directions; the
fraction of the area whose normal is flipped relative to the nearest vertex of the original; and the
CPU time.

    pip install tofuse[bench]
    tofuse demo --out room
    python benchmarks/decimation.py room [another result...] [--faces 60000]
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.geometry.kdtree import KdTree
from tofuse.formats.geometry.ply import read_ply
from tofuse.lab.experiments.surface_error import Surface, distances

_POINTS = 400_000
_SAMPLES = 4_000_000  # of the surface to which distances are measured

Shape = tuple[NDArray[np.floating], NDArray[np.integer]]  # vertices and faces


def clustering(mesh: Mesh, faces: int) -> Shape:
    small = mesh.clustered(faces)
    return small.vertices, small.faces


def edge_collapse(mesh: Mesh, faces: int) -> Shape:
    small = mesh.decimated(faces)
    return small.vertices, small.faces


def open3d(mesh: Mesh, faces: int) -> Shape:
    small = mesh.to_open3d().simplify_quadric_decimation(faces)
    return np.asarray(small.vertices), np.asarray(small.triangles)


METHODS: dict[str, Callable[[Mesh, int], Shape]] = {
    "clustering": clustering,
    "edge collapse": edge_collapse,
    "open3d": open3d,
}


def loaded(folder: Path) -> Mesh:
    """Load the mesh of a result."""
    ply = read_ply(folder / "mesh.ply")
    assert ply.faces is not None
    assert ply.normals is not None
    unknown = np.zeros(len(ply))
    return Mesh(
        ply.points.astype(np.float32), ply.faces, ply.normals, ply.color,
        unknown.astype(np.float32), unknown.astype(np.int32),
    )  # fmt: skip


def flipped(mesh: Mesh, shape: Shape) -> float:
    """Fraction of the area of a decimated mesh with flipped normals."""
    corners = shape[0][shape[1]].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    nearest, _ = KdTree(mesh.vertices).neighbours(corners.mean(1).astype(np.float32), 1)
    away = np.einsum("ni,ni->n", normals, mesh.normals[nearest[:, 0]]) < 0
    return float(area[away].sum() / area.sum())


def statistics(distances_m: Float64 | Float32) -> str:
    """Mean, 99th percentile and maximum in mm."""
    mm = 1000 * distances_m
    return f"{mm.mean():.2f} / {np.percentile(mm, 99):.1f} / {mm.max():.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", nargs="+", type=Path)
    parser.add_argument("--faces", type=int, default=60_000)
    given = parser.parse_args()
    for folder in given.results:
        mesh = loaded(folder)
        whole = Surface(mesh.vertices.astype(float), mesh.faces)
        print(f"{folder.name}: {len(mesh.faces)} triangles, reduced to {given.faces}\n")
        print(
            "| method | triangles | original to reduced | reduced to original | flipped | CPU s |"
        )
        print("|---|---|---|---|---|---|")
        for name, reduce in METHODS.items():
            if name == "open3d" and importlib.util.find_spec(name) is None:
                print(f"| {name} | not installed | | | | |")
                continue
            if name != "open3d":
                reduce(mesh, given.faces)  # compiles
            start = time.process_time()
            shape = reduce(mesh, given.faces)
            seconds = time.process_time() - start
            reduced = Surface(shape[0].astype(float), shape[1])
            there = distances(whole.samples(_POINTS)[0], reduced, _SAMPLES)
            back = distances(reduced.samples(_POINTS)[0], whole, _SAMPLES)
            print(
                f"| {name} | {len(shape[1])} | {statistics(there)} | {statistics(back)} "
                f"| {flipped(mesh, shape):.1%} | {seconds:.1f} |",
                flush=True,
            )
        print()


if __name__ == "__main__":
    main()
