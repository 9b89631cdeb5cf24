"""The surface that people look at: without shards, and with small holes filled.

A surface that was measured is supported by the views that look at it. Along the edges of objects,
images also have depths in between, which views from elsewhere do not confirm: shards. And where
nothing was measured, a hole is filled if its rim is that of a surface that goes on, and if views do
not see through it. The fused surface and the cloud keep what was measured, and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float32, Float64, Int32, Int64, Intp
from tofuse.engine.cameras import Camera
from tofuse.engine.compute import run_chunks
from tofuse.engine.frames import RangeFrame
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.geometry import se3, tangents

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_Pixel = TypeVar("_Pixel", np.float32, np.bool_)
# Columns of depth images that tell what is seen: whole ones tell no more, but fill the memory.
_MAX_COLUMNS = 480
# Depth tolerance of the visibility test: m, plus a fraction of the depth.
TOLERANCE_M, TOLERANCE_FRACTION = 0.02, 0.02
# Vertices are supported by this fraction of the usual number of views, of those that look at them;
# holes are those that fewer see through. Both lie between chance (noise, edges) and the usual 1.
_SUPPORTED, _SEEN_THROUGH = 1 / 3, 1 / 3
# Number of witnesses that see a surface, above which none does so by chance in 5 % of the cases.
_EXPECTED = 3.0
# Diameter of a hole, in spacings of the vertices, below which its rim may have any shape.
_SMALL = 3.0
# Of a flat rim: largest distance from its plane as a fraction of its diameter, and smallest cosine
# of normals to that of the plane.
_FLATNESS, _MIN_COSINE = 0.1, 0.85
# A larger hole is filled if this fraction of a ring around it, as wide as its radius, is there.
_RING_FRACTION = 0.5
_MAX_RIM = 100  # vertices
_ISLAND = 30  # vertices of what is left of a shard


@dataclass(frozen=True, eq=False)
class Witness:
    """What a view tells of a surface.

    Attributes
    ----------
    z
        (H, W) m, 0 where unknown, as of `reduced`.
    camera, T_world_camera
        The camera and its pose.
    """

    z: Float32
    camera: Camera
    T_world_camera: Float64

    @classmethod
    def of(cls, frame: RangeFrame, T_world_camera: Float64) -> Witness:
        """Take the depth of a frame at its pose."""
        z = np.nan_to_num(np.asarray(frame.z, np.float32))
        return cls(reduced(z, reduction(z)), frame.camera, T_world_camera)

    def looks(self, points: Float64, normals: Float64 | None = None) -> tuple[Bool, Float64]:
        """Return which points (N, 3) are in the image, from the front; and what is seen there.

        The latter is the distance (N,) of the seen surface behind a point, in tolerances: -1 to 1
        at the point, NaN where the depth is unknown.
        """
        T = se3.inverse(self.T_world_camera)
        p = points @ T[:3, :3].T + T[:3, 3]
        inside = p[:, 2] > 0
        if normals is not None:
            inside &= ((normals @ T[:3, :3].T) * p).sum(1) < 0
        rows = np.flatnonzero(inside)
        height, width = self.z.shape
        step = self.camera.width // width
        pixels = np.rint((self.camera.project(p[rows]) + 0.5) / step - 0.5)
        within = ((pixels >= 0) & (pixels < [width, height])).all(1)  # NaN is not
        inside[rows[~within]] = False
        u, v = pixels[within].astype(np.intp).T
        seen = self.z[v, u].astype(float)
        behind = np.full(len(points), np.nan)
        tolerance = TOLERANCE_M + TOLERANCE_FRACTION * seen
        behind[inside] = np.where(seen > 0, (seen - p[inside, 2]) / tolerance, np.nan)
        return inside, behind


def reduction(z: Float32) -> int:
    """Return by which power of two images of depth (H, W) are subsampled to tell what is seen."""
    step = 1
    while z.shape[1] > _MAX_COLUMNS * step and not any(n % (2 * step) for n in z.shape):
        step *= 2
    return step


def reduced(image: NDArray[_Pixel], step: int) -> NDArray[_Pixel]:
    """Return the pixel at the middle of each `step` x `step` of an image; a copy, to free it."""
    return image if step == 1 else image[step // 2 :: step, step // 2 :: step].copy()


def displayed(mesh: Mesh, witnesses: Sequence[Witness]) -> tuple[Mesh, int]:
    """Return the mesh without shards and small holes, and the number of triangles in holes, last.

    Parameters
    ----------
    mesh
        With faces, all of them measured.
    witnesses
        Views from all over the recording.
    """
    trimmed = without_shards(mesh, witnesses).without_islands(_ISLAND)
    return with_filled_holes(trimmed, witnesses) if len(trimmed.faces) else (mesh, 0)


def without_shards(mesh: Mesh, witnesses: Sequence[Witness]) -> Mesh:
    """Return the mesh without what the views that look at it do not support.

    Triangles stay if most of their vertices are supported. Of the witnesses that look at a vertex
    at least one sees it there, and the number of fused views, `Mesh.views`, is not far below the
    usual one, relative to the number of witnesses that look. Where none does, as witnesses are a
    sample, or the vertex is behind another surface, its number of views decides.
    """
    points, normals = mesh.vertices.astype(float), mesh.normals.astype(float)

    def counts(first: int, last: int) -> Int64:
        total = np.zeros((3, len(mesh)), np.int64)
        for witness in witnesses[first:last]:
            inside, behind = witness.looks(points, normals)
            with np.errstate(invalid="ignore"):
                hidden = inside & (behind < -1)
                total += [inside & ~hidden, inside & (np.abs(behind) <= 1), hidden]
        return total

    none = np.zeros((3, len(mesh)), np.int64)
    looking, seeing, hidden = sum(run_chunks(counts, len(witnesses)), none)
    is_looked_at = looking > 0
    share = mesh.views[is_looked_at] / looking[is_looked_at]
    usual = float(np.median(share)) if len(share) else 0.0
    few = mesh.views < _SUPPORTED * np.where(is_looked_at, usual * looking, np.median(mesh.views))
    # Those that fused views would let expect, if the surface were not behind another one.
    expected = mesh.views * (np.median(seeing) / max(float(np.median(mesh.views)), 1))
    unseen = (seeing == 0) & (is_looked_at | ((hidden > 0) & (expected >= _EXPECTED)))
    return mesh.rows((~few & ~unseen)[mesh.faces].sum(1) >= 2)


def with_filled_holes(mesh: Mesh, witnesses: Sequence[Witness]) -> tuple[Mesh, int]:
    """Return the mesh with holes filled, and the number of the added triangles, which are last."""
    from scipy.spatial import cKDTree  # slow to import

    loops = [loop for loop in boundary_loops(mesh.faces) if 3 <= len(loop) <= _MAX_RIM]
    tree = cKDTree(mesh.vertices)
    spacing = mesh.spacing
    fills = [fill for loop in loops if (fill := _fill(mesh, loop, tree, spacing)) is not None]
    if not fills:
        return mesh, 0
    faces = np.concatenate(fills)
    hole = np.repeat(np.arange(len(fills)), [len(fill) for fill in fills])
    centroids = mesh.vertices[faces].mean(1, dtype=float)
    looking, through = np.zeros(len(fills)), np.zeros(len(fills))
    for witness in witnesses:
        inside, behind = witness.looks(centroids)
        with np.errstate(invalid="ignore"):
            looking += np.bincount(hole[inside & ~(behind < -1)], minlength=len(fills))
            through += np.bincount(hole[inside & (behind > 1)], minlength=len(fills))
    kept = faces[((through < _SEEN_THROUGH * looking) & (looking > 0))[hole]]
    return mesh.with_vertices(np.ones(len(mesh), bool), np.concatenate([mesh.faces, kept])), len(
        kept
    )


def boundary_loops(faces: Int32) -> Iterator[Intp]:
    """Yield the closed rims of a mesh: rows of vertices, the surface on their right."""
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
    count = int(faces.max(initial=-1)) + 1
    is_rim = ~np.isin(edges[:, 1] * count + edges[:, 0], edges[:, 0] * count + edges[:, 1])
    following: dict[int, list[int]] = {}
    for a, b in edges[is_rim].tolist():
        following.setdefault(b, []).append(a)
    for first in list(following):
        path: list[int] = []
        place: dict[int, int] = {}
        vertex = first
        while True:
            if vertex in place:  # a loop is closed, perhaps where several rims touch
                at = place[vertex]
                yield np.array(path[at:], np.intp)
                for passed in path[at:]:
                    del place[passed]
                del path[at:]
            if not following.get(vertex):
                break
            place[vertex] = len(path)
            path.append(vertex)
            vertex = following[vertex].pop()


def _fill(mesh: Mesh, loop: Intp, tree: cKDTree, spacing: float) -> Int32 | None:
    """Return triangles (K, 3) that fill a hole; None if its rim does not suggest a surface."""
    rim = mesh.vertices[loop].astype(float)
    centre = rim.mean(0)
    normals = mesh.normals[loop].astype(float)
    normal = normals.mean(0)
    length = float(np.linalg.norm(normal))
    diameter = 2 * float(np.linalg.norm(rim - centre, axis=1).max())
    if length < 1e-6 or diameter <= 0:
        return None
    normal /= length
    if diameter > _SMALL * spacing:
        flat = np.abs((rim - centre) @ normal) <= _FLATNESS * diameter
        if not (flat & (normals @ normal >= _MIN_COSINE)).all():
            return None
        around = np.array(tree.query_ball_point(centre, diameter), np.intp)
        offset = mesh.vertices[around] - centre
        in_plane = np.abs(offset @ normal) <= _FLATNESS * diameter
        in_plane &= mesh.normals[around] @ normal >= _MIN_COSINE
        in_plane &= np.linalg.norm(offset, axis=1) > 0.5 * diameter
        # A vertex stands for a square of the spacing.
        if in_plane.sum() * spacing**2 < _RING_FRACTION * 0.75 * np.pi * diameter**2:
            return None
    corners = triangulated((rim - centre) @ tangents(normal).T)
    return None if corners is None else loop[corners].astype(np.int32)


def triangulated(polygon: Float64) -> Intp | None:
    """Return the triangles (n - 2, 3) of a counter-clockwise polygon (n, 2), by ear clipping.

    The best shaped ear first; None if the polygon is clockwise or crosses itself.
    """
    rest = list(range(len(polygon)))
    out = []

    def quality(k: int) -> float:
        """Area by squared perimeter of the ear at the k-th remaining corner; 0 if it is none."""
        row = rest[k - 1], rest[k], rest[(k + 1) % len(rest)]
        a, b, c = polygon[list(row)]
        double = float((b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0])
        if double <= 0:
            return 0.0
        others = polygon[[r for r in rest if r not in row]]
        for p, q in ((a, b), (b, c), (c, a)):
            others = others[(q - p)[0] * (others - p)[:, 1] - (q - p)[1] * (others - p)[:, 0] >= 0]
        if len(others):
            return 0.0
        return double / float(sum(np.linalg.norm(q - p) for p, q in ((a, b), (b, c), (c, a)))) ** 2

    scores = [quality(k) for k in range(len(rest))]
    while len(rest) > 3:
        k = int(np.argmax(scores))
        if scores[k] <= 0:
            return None
        out.append((rest[k - 1], rest[k], rest[(k + 1) % len(rest)]))
        del rest[k], scores[k]
        for near in (k - 1, k % len(rest)):
            scores[near] = quality(near)
    if quality(1) <= 0:
        return None
    return np.array([*out, tuple(rest)], np.intp)
