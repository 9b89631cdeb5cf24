"""The content of the 3D view: model, cameras and loops as compact arrays, and a still image."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from tofuse.apps.report import thumbnails
from tofuse.apps.report.packing import normal_bytes, pack, quantized
from tofuse.apps.results import QUALITY, viridis
from tofuse.engine.arrays import Float32, Float64, Int32, Intp, UInt8, UInt16
from tofuse.engine.fusion import Cloud, Mesh, Textured, drawing
from tofuse.engine.geometry import se3, sphere_directions, triangles, unit_vectors
from tofuse.engine.results import Reconstruction
from tofuse.formats.images import jpeg_bytes

MAX_POINTS = 150_000
_MAX_SEGMENTS = 1000  # segments of a trajectory
_MAX_EXTENT_RATIO = 1.8  # of model and cameras to the model; beyond, cameras are not framed
_MAX_NORMALS, _MIN_AREA_RATIO = 5000, 1.05  # sampled normals; area to the default view's
_DIRECTIONS = 100  # in which the outermost points are framed
_MAX_FRAMED = 50_000  # of these points
# Of the cameras of a rig, in their order; the first is also that of a single camera.
CAMERA_COLORS = (
    (90, 176, 245), (243, 122, 160), (95, 208, 138), (226, 200, 84),
    (178, 144, 245), (240, 140, 84), (84, 214, 214), (205, 208, 214),
)  # fmt: skip
YAW, PITCH = -0.5, 0.75  # rad, the view that the report opens with


@dataclass(frozen=True, eq=False)
class Scene:
    """The content of the 3D view, in the world frame.

    Attributes
    ----------
    points, colors, normals
        (K, 3) float64 m, (K, 3) uint8, (K, 3) float or None where the cloud has none.
    total
        Number of points of the full model.
    spacing
        Typical distance between neighbouring points shown, m.
    before, after, reference
        (n, 4, 4) finite poses T_world_camera before and after loop closure, and of the reference;
        may be empty.
    loops
        (L, 2, 3) camera centres of the accepted loop closures.
    surface
        The full surface; None without one.
    texture
        The texture of the surface, which is then `Textured.charts`; None without one.
    sigma, views
        (K,) standard deviation of the points, m, and (K,) number of views that observed them; None
        if unknown.
    outer
        Percentage of the points at each end of each axis that needn't be in view at first.
    """

    points: Float64
    colors: UInt8
    normals: Float32 | Float64 | None
    total: int
    spacing: float
    before: Float64 = field(default_factory=lambda: np.zeros((0, 4, 4)))
    after: Float64 = field(default_factory=lambda: np.zeros((0, 4, 4)))
    reference: Float64 = field(default_factory=lambda: np.zeros((0, 4, 4)))
    loops: Float64 = field(default_factory=lambda: np.zeros((0, 2, 3)))
    surface: Mesh | None = None
    texture: Textured | None = None
    sigma: Float32 | None = None
    views: Int32 | None = None
    outer: float = 0.5

    @cached_property
    def mesh(self) -> Mesh | None:
        """The surface, simplified for a browser on a phone; None without one."""
        if self.surface is None or len(self.surface.faces) == 0:
            return None
        return self.surface if self.texture is not None else self.surface.overview

    @property
    def box(self) -> Float64:
        """(2, 3) corners of the box to be shown, without the outermost points.

        It includes the cameras unless they would enlarge it much, like those around an object.
        """
        points, cameras = self.points, self.after[:, :3, 3]
        boxes = [np.percentile(p, [3, 97], axis=0) for p in (points, cameras) if len(p)]
        if not boxes:
            return np.zeros((2, 3))
        combined = np.stack([np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)])
        combined_size, points_size = (
            float(np.linalg.norm(np.ptp(box, axis=0))) for box in (combined, boxes[0])
        )
        return (
            boxes[0]
            if points_size > 0 and combined_size > _MAX_EXTENT_RATIO * points_size
            else combined
        )

    @property
    def framed(self) -> Float64:
        """(K, 3) extreme points of the model, to be in view; cameras are hidden at first."""
        return extreme_points(self.points, self.outer) if len(self.points) else self.box

    @property
    def center(self) -> Float64:
        """(3,) centre of rotation of the view."""
        return self.box.mean(0)

    @property
    def size(self) -> float:
        """Diagonal of the box, m; positive."""
        return max(float(np.linalg.norm(np.ptp(self.box, axis=0))), 1e-3)

    def view_rotation(self, R: Float64) -> Scene:
        """Return the scene in the axes given by the rows of R (3, 3)."""
        T = se3.pose(R)
        return replace(
            self,
            points=self.points @ R.T,
            normals=None if self.normals is None else self.normals @ R.T,
            before=T @ self.before,
            after=T @ self.after,
            reference=T @ self.reference,
            loops=self.loops @ R.T,
            surface=self.mesh
            and replace(
                self.mesh,
                vertices=(self.mesh.vertices @ R.T).astype(np.float32),
                normals=(self.mesh.normals @ R.T).astype(np.float32),
            ),
        )


def finite_poses(poses: Float64 | None) -> Float64:
    """Return the finite poses, (n, 4, 4)."""
    if poses is None or len(poses) == 0:
        return np.zeros((0, 4, 4))
    return poses[np.isfinite(poses).all((1, 2))]


def make_scene(
    result: Reconstruction,
    rows: dict[int, int],
    reference: Float64 | None = None,
    texture: Textured | None = None,
) -> Scene:
    """Collect and subsample the content of the 3D view.

    Parameters
    ----------
    result
        The result.
    rows
        Row of the trajectory, by frame index.
    reference
        (N, 4, 4) reference poses, NaN where there is none; or None.
    texture
        The surface with a texture, if there is one.
    """
    cloud = result.cloud
    sampled = random_subset(len(cloud), MAX_POINTS)
    points = cloud.points[sampled].astype(float)
    finite = np.isfinite(points).all(1)
    points, sampled = points[finite], sampled[finite]
    ends = [
        (result.trajectory[rows[p.i], :3, 3], result.trajectory[rows[p.j], :3, 3])
        for p in result.diagnostics.loops
        if p.accepted and p.i in rows and p.j in rows
    ]
    loops = np.array(ends, float).reshape(-1, 2, 3)
    return Scene(
        points,
        _colors(cloud, sampled, points),
        None if cloud.normals is None else cloud.normals[sampled],
        len(cloud),
        spacing_of(points),
        finite_poses(result.diagnostics.sequential),
        finite_poses(result.trajectory),
        finite_poses(reference),
        loops[np.isfinite(loops).all((1, 2))],
        _display_colors(result.mesh) if texture is None else texture.charts,
        texture,
        None if cloud.sigma is None else cloud.sigma[sampled],
        None if cloud.views is None else cloud.views[sampled],
    )


def packed(scene: Scene) -> dict[str, Any]:
    """Return the scene for the viewer: plain data, arrays as `pack` packs them.

    Where there is a surface its vertices are the points that are shown.
    """
    mesh = scene.mesh
    points = scene.points if mesh is None else mesh.vertices.astype(float)
    low = points.min(0) if len(points) else np.zeros(3)
    extent = np.maximum(np.ptp(points, axis=0), 1e-6) if len(points) else np.ones(3)
    return {
        "count": len(points),
        "low": low.tolist(),
        "extent": extent.tolist(),
        "center": scene.center.tolist(),
        "size": scene.size,
        "framed": np.round(scene.framed, 4).tolist(),
        "spacing": scene.spacing if mesh is None else spacing_of(points),
        "yaw": opening_yaw(scene),
        "pitch": PITCH,
        "model": _packed_model(scene, quantized(points, low, extent)) if len(points) else None,
        "lines": {
            "reference": pack(path_lines(scene.reference).astype("<f4")),
            "loops": pack(scene.loops.reshape(-1, 3).astype("<f4")),
        },
    }


def _packed_model(scene: Scene, steps: UInt16) -> dict[str, Any]:
    mesh = scene.mesh
    if mesh is None:
        normals, colors, faces = scene.normals, scene.colors, None
    else:
        normals, faces = mesh.normals, pack(mesh.faces.astype("<u4"))
        colors = _mesh_colors(mesh)
    return {
        "points": pack(steps),
        "colors": pack(colors),
        "normals": None if normals is None else pack(normal_bytes(normals)),
        "faces": faces,
        **_packed_texture(scene.texture),
    }


def _mesh_colors(mesh: Mesh) -> UInt8:
    return height_colors(mesh.vertices.astype(float)) if mesh.color is None else mesh.color


def _packed_texture(texture: Textured | None) -> dict[str, Any]:
    if texture is None:
        return {"uv": None, "texture": None, "filled": 0}
    uv = quantized(texture.atlas.uv.astype(float), np.zeros(2), np.ones(2))
    image = base64.b64encode(jpeg_bytes(texture.image, QUALITY)).decode()
    return {"uv": pack(uv), "texture": f"data:image/jpeg;base64,{image}", "filled": texture.filled}


def _display_colors(mesh: Mesh | None) -> Mesh | None:
    if mesh is None or mesh.color is None:
        return mesh
    return replace(mesh, color=drawing.display_colors(mesh.color))


def opening_yaw(scene: Scene) -> float:
    """Return the yaw in rad that shows the largest front-facing area of the model.

    The best of eight directions, but `YAW` unless another one shows considerably more.
    """
    normals = scene.normals if scene.mesh is None else scene.mesh.normals
    if normals is None or not len(normals):
        return YAW
    sampled = np.nan_to_num(normals[:: -(-len(normals) // _MAX_NORMALS)].astype(float))
    yaws = YAW + np.arange(8) * np.pi / 4
    view_directions = np.array([-thumbnails.view_rotation(yaw, PITCH)[2] for yaw in yaws])
    visible_area = np.maximum(sampled @ view_directions.T, 0).sum(0)
    best = int(visible_area.argmax())
    return float(yaws[best]) if visible_area[best] > _MIN_AREA_RATIO * visible_area[0] else YAW


def path_lines(poses: Float64) -> Float64:
    """Return end points of the lines (2 n, 3) that join the camera centres in order.

    Of long trajectories every k-th centre is joined: wide lines cost a browser more than triangles.
    """
    centers = poses[:, :3, 3]
    step = max(1, -(-len(centers) // _MAX_SEGMENTS))
    centers = np.concatenate([centers[:-1:step], centers[-1:]])
    return np.stack([centers[:-1], centers[1:]], axis=1).reshape(-1, 3)


def render(scene: Scene, size: tuple[int, int] = (960, 600), *, yaw: float = YAW) -> UInt8:
    """Render the initial 3D view, so that it fills an image (H, W, 3), for use without WebGL."""
    import cv2

    points = scene.points if scene.mesh is None else scene.mesh.vertices.astype(float)
    framed = points if len(points) else scene.after[:, :3, 3]
    T, scale = thumbnails.framing(framed, size, yaw=yaw, pitch=PITCH)
    R, t = T[:3, :3], T[:3, 3]
    # Smaller, so that the nearest points, which appear largest, fit.
    depth = float(np.ptp(np.percentile(framed @ R[2], [0.2, 99.8]))) if len(framed) else 0.0
    distance = 1.5 * (scene.size + depth)
    lens: Any = {"scale": scale * (1 - 0.5 * depth / distance), "distance": distance}
    eye = -R.T @ (t + np.array([0.0, 0.0, distance]))
    image = (_drawn_points if scene.mesh is None else _drawn_surface)(scene, T, eye, size, lens)
    for poses, color in ((scene.before, (240, 160, 60)), (scene.after, (90, 176, 245))):
        pixels, depths = thumbnails.project(poses[:, :3, 3], T, size, **lens)
        path = np.rint(pixels[np.isfinite(depths)]).astype(np.int32)
        image = np.asarray(cv2.polylines(image, [path], False, color, 2, cv2.LINE_AA), np.uint8)
    return image


def _drawn_points(
    scene: Scene, T: Float64, eye: Float64, size: tuple[int, int], lens: Any
) -> UInt8:
    points, colors = scene.points, 36 + 0.86 * scene.colors
    if scene.normals is not None and len(points):
        # Surfaces that face away are walls in front of the interior.
        facing = _cosines(points, scene.normals, eye)
        colors = colors * (0.6 + 0.4 * np.abs(facing[:, None]))
        points, colors = points[facing >= 0], colors[facing >= 0]
    radius = int(np.clip(np.ceil(1.5 * scene.spacing * lens["scale"]), 2, 6))
    rgba = thumbnails.splat(points, colors.astype(np.uint8), T, size, radius=radius, **lens)
    return np.where(rgba[..., 3:] > 0, rgba[..., :3], np.array(thumbnails.BACKGROUND, np.uint8))


def _drawn_surface(
    scene: Scene, T: Float64, eye: Float64, size: tuple[int, int], lens: Any
) -> UInt8:
    mesh = scene.mesh
    assert mesh is not None
    vertices = mesh.vertices.astype(float)
    light = 0.6 + 0.4 * np.abs(_cosines(vertices, mesh.normals, eye))
    mesh = replace(mesh, color=(light[:, None] * _mesh_colors(mesh)).astype(np.uint8))
    corners = vertices[mesh.faces]
    normals = triangles.crosses(corners)
    pixels, depths = thumbnails.project(vertices, T, size, **lens)
    shown = (_cosines(corners[:, 0], normals, eye) > 0) & (depths[mesh.faces] > 0).all(1)
    t = scene.texture
    texture = None if t is None else (t.atlas.texels, t.image)
    image, distance = drawing.drawn(mesh, pixels, depths, shown, size, texture)
    background = np.array(thumbnails.BACKGROUND, np.float32)
    image = np.where(distance[..., None] > 0, 36 + 0.86 * image, background)
    return np.asarray(image, np.uint8)


def _cosines(points: Float64, normals: Float32 | Float64, eye: Float64) -> Float64:
    """Return (N,) scalar products of unit vectors from points (N, 3) to the eye with normals."""
    return np.asarray((unit_vectors(eye - points) * np.nan_to_num(normals)).sum(1), np.float64)


def extreme_points(points: Float64, outer: float) -> Float64:
    """Return the extreme points (K, 3) in many directions, without outliers, of a sample.

    Parameters
    ----------
    points
        (N, 3).
    outer
        Percentage of points at each end of each axis that count as outliers.
    """
    points = points[random_subset(len(points), _MAX_FRAMED)]
    low, high = np.percentile(points, [outer, 100 - outer], axis=0)
    inside = points[((points >= low) & (points <= high)).all(1)]
    points = inside if len(inside) else points
    return points[np.unique((points @ sphere_directions(_DIRECTIONS).T).argmax(0))]


def random_subset(count: int, max_count: int) -> Intp:
    """Return the indices of at most `max_count` points, random to avoid regular patterns."""
    if count <= max_count:
        return np.arange(count)
    return np.sort(np.random.default_rng([0, count]).permutation(count)[:max_count])


def _colors(cloud: Cloud, sampled: Intp, points: Float64) -> UInt8:
    if cloud.color is not None:
        return drawing.display_colors(cloud.color[sampled])
    return height_colors(points)


def height_colors(points: Float64) -> UInt8:
    """Return colours (N, 3) of points by height, which is -y."""
    low, high = thumbnails.percentile_range(-points[:, 1])
    return viridis(0.1 + 0.9 * (-points[:, 1] - low) / max(high - low, 1e-6))


def spacing_of(points: Float64) -> float:
    """Return the typical distance in m between neighbours among points (N, 3)."""
    if len(points) < 2:
        return 0.01
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(points).query(points[:: max(1, len(points) // 2000)], k=2)
    return float(max(np.median(distances[:, 1]), 1e-5))
