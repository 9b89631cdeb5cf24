"""Two registered views in 3D: before, after, and coloured by the distance between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tofuse.arrays import Float64, Intp, UInt8
from tofuse.geometry import se3
from tofuse.recordings.frames import CloudFrame, Frame
from tofuse.registration.shape import normals_at
from tofuse.report import thumbnails
from tofuse.report.packing import normal_bytes, pack, quantized
from tofuse.report.scene import Scene, extreme_points, random_subset, render, spacing_of
from tofuse.results.pair import LocalView, PairResult

SOURCE, TARGET = (240, 160, 60), (90, 176, 245)
MODES = ("before", "after", "distance")
MAX_POINTS = 45_000  # of each view; about 2 MB for both
_MAX_SEARCHED = 400_000  # points of each view in the nearest-neighbour search
_NEIGHBOURS = 30  # points of a local plane fit
_MIN_COLOR = 0.2  # of viridis, whose darkest colours are invisible on a dark background
# The colour bar ends at this multiple of the median distance of points within a number of rms.
_MEDIANS_PER_CAP, _MAX_RMS = 4.0, 10.0
_UNMATCHED_CAPS = 4.0  # points beyond this multiple of the colour bar's end have no counterpart
_MAX_EXTENT_RATIO = 2.5  # the initial pose is framed separately if it enlarges the scene more
_Z_UP = ("las", "e57")  # formats of scanners and maps; cameras look along z
_MIN_BEHIND = 0.1  # minimum fraction of points behind the origin that excludes a camera
_SIZE = (720, 480)  # of a rendered view, in pixels
_MIN_POINT_PIXELS = 2  # minimum side of a point


@dataclass(frozen=True, eq=False)
class _SampledView:
    """A subsampled view in its local frame, and its distances in m to the other one."""

    points: Float64
    normals: Float64 | None
    distance: Float64
    total: int


@dataclass(frozen=True, eq=False)
class PairScene:
    """The content of the page's 3D view.

    Attributes
    ----------
    cap_m
        Distance at the end of the colour bar.
    max_distance_m
        Distance beyond which a point has no counterpart.
    median_m, fraction
        Median distance of the points with a counterpart, and their fraction, 0 to 1.
    layers
        Source and target in the target's local frame, for each of `MODES`.
    yaw, pitch
        Initial viewing direction, rad.
    shown, total
        Number of points shown, and of all points.
    """

    cap_m: float
    max_distance_m: float
    median_m: float
    fraction: float
    layers: dict[str, tuple[Scene, Scene]]
    yaw: float
    pitch: float
    shown: int
    total: int


def pair_scene(result: PairResult) -> PairScene:
    """Subsample both views and compute the distances between them."""
    T = result.registration.T_target_source
    source, target = _search_points(result.source.frame), _search_points(result.target.frame)
    target_points = target.points.astype(float)
    source_points = se3.transform(T, source.points.astype(float))
    a = _sampled_view(source, source_points, target_points, len(result.source.frame))
    b = _sampled_view(target, target_points, source_points, len(result.target.frame))
    all_distances = np.concatenate([a.distance, b.distance])
    max_distance = _MAX_RMS * result.registration.rms_m
    matched = (
        all_distances[all_distances <= max_distance]
        if (all_distances <= max_distance).any()
        else all_distances[np.isfinite(all_distances)]
    )
    cap = _round_up(
        max(_MEDIANS_PER_CAP * float(np.median(matched)) if len(matched) else 0.0, 1e-3)
    )
    matched = all_distances[all_distances <= _UNMATCHED_CAPS * cap]
    z_up = any(_is_z_up(view) for view in (result.source, result.target))
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if z_up else np.eye(3)

    def scene(view: _SampledView, pose: Float64, colors: UInt8) -> Scene:
        R = axes @ pose[:3, :3]
        points = view.points @ R.T + axes @ pose[:3, 3]
        normals = None if view.normals is None else view.normals @ R.T
        no_poses = np.zeros((0, 4, 4))
        return Scene(
            points, colors, normals, view.total, spacing_of(points), no_poses, no_poses, no_poses,
            np.zeros((0, 2, 3)),
        )  # fmt: skip

    identity = np.eye(4)
    target_scene = scene(b, identity, _uniform(TARGET, len(b.points)))
    layers = {
        "before": (scene(a, result.T_start, _uniform(SOURCE, len(a.points))), target_scene),
        "after": (scene(a, T, _uniform(SOURCE, len(a.points))), target_scene),
        "distance": (
            scene(a, T, distance_colors(a.distance, cap)),
            scene(b, identity, distance_colors(b.distance, cap)),
        ),
    }
    return PairScene(
        cap,
        _UNMATCHED_CAPS * cap,
        float(np.median(matched)) if len(matched) else float("nan"),
        len(matched) / max(len(all_distances), 1),
        layers,
        *((-0.5, 0.7) if z_up else (-0.3, 0.3)),
        shown=len(a.points) + len(b.points),
        total=a.total + b.total,
    )


def distance_colors(distance: Float64, cap_m: float) -> UInt8:
    """Return colours (N, 3) of distances in m; grey for points without a counterpart."""
    fraction = np.clip(distance / cap_m, 0, 1)
    colors = thumbnails.viridis(_MIN_COLOR + (1 - _MIN_COLOR) * fraction)
    colors[distance > _UNMATCHED_CAPS * cap_m] = thumbnails.NO_MEASUREMENT
    return colors


def color_bar() -> str:
    """Return the colour bar as a CSS gradient."""
    stops = thumbnails.viridis(np.linspace(_MIN_COLOR, 1, 9))
    return f"linear-gradient(to right, {', '.join(f'rgb({r},{g},{b})' for r, g, b in stops)})"


def distances(points: Float64, others: Float64, chosen: Intp) -> Float64:
    """Return distances (n,) in m of points from the surface of others.

    The distance between local means of both views along the normal of the other one, like M3C2
    (Lague et al. 2013), which reduces noise. Infinite where the other view has no surface.

    Parameters
    ----------
    points, others
        (N, 3) and (M, 3), m, in the same frame.
    chosen
        (n,) rows of `points`.
    """
    from scipy.spatial import cKDTree

    if min(len(points), len(others)) < _NEIGHBOURS:
        return np.full(len(chosen), np.inf)
    _, neighbours = cKDTree(points).query(points[chosen], k=_NEIGHBOURS)
    means = points[neighbours].mean(1)
    # The neighbours of the nearest point form a patch even at an edge, those of the query may not.
    tree = cKDTree(others)
    _, nearest = tree.query(means)
    _, other_neighbours = tree.query(others[nearest], k=_NEIGHBOURS)
    patch = others[other_neighbours]
    centroid = patch.mean(1)
    centred = patch - centroid[:, None]
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    offset = means - centroid
    normal_distance = np.abs((offset * vectors[..., 0]).sum(1))
    tangential_distance = np.sqrt(np.maximum((offset**2).sum(1) - normal_distance**2, 0))
    patch_radius = np.sqrt((centred**2).sum(2).max(1))
    return np.where(tangential_distance <= patch_radius, normal_distance, np.inf)


def packed(scene: PairScene) -> dict[str, Any]:
    """Return the scene for the viewer: plain data, arrays as `pack` packs them."""
    arrays: dict[str, str] = {}
    layers = []
    for mode in MODES:
        for view, layer in zip(("source", "target"), scene.layers[mode], strict=True):
            low = layer.points.min(0)
            extent = np.maximum(np.ptp(layer.points, axis=0), 1e-6)
            # "after" and "distance" share their arrays.
            key = view if view == "target" or mode != "before" else "start"
            if key not in arrays:
                arrays[key] = pack(quantized(layer.points, low, extent))
                if layer.normals is not None:
                    arrays[f"{key} normals"] = pack(normal_bytes(layer.normals))
            colors = None
            if mode == "distance":
                colors = f"{view} colors"
                arrays[colors] = pack(layer.colors)
            layers.append(
                {
                    "mode": mode,
                    "view": view,
                    "count": len(layer.points),
                    "low": low.tolist(),
                    "extent": extent.tolist(),
                    "spacing": layer.spacing,
                    "points": key,
                    "normals": f"{key} normals" if layer.normals is not None else None,
                    "colors": colors,
                    "color": list(SOURCE if view == "source" else TARGET),
                }
            )
    outlines = framing(scene)
    box = np.stack([outlines["after"].min(0), outlines["after"].max(0)])
    return {
        "count": 0,
        "low": box[0].tolist(),
        "extent": np.ptp(box, axis=0).tolist(),
        "center": box.mean(0).tolist(),
        "size": max(float(np.linalg.norm(np.ptp(box, axis=0))), 1e-3),
        "outlines": {mode: np.round(points, 4).tolist() for mode, points in outlines.items()},
        "spacing": 0.01,
        "yaw": scene.yaw,
        "pitch": scene.pitch,
        "model": None,
        "lines": {},
        "arrays": arrays,
        "layers": layers,
    }


def framing(scene: PairScene) -> dict[str, Float64]:
    """Return the extreme points (K, 3) of each mode: common ones, unless the start is distant."""
    after = np.concatenate([extreme_points(layer.points) for layer in scene.layers["after"]])
    before = np.concatenate([extreme_points(layer.points) for layer in scene.layers["before"]])
    combined = np.concatenate([after, before])
    if np.linalg.norm(np.ptp(combined, axis=0)) <= _MAX_EXTENT_RATIO * np.linalg.norm(
        np.ptp(after, axis=0)
    ):
        return dict.fromkeys(MODES, combined)
    return {"before": before, "after": after, "distance": after}


def render_modes(scene: PairScene) -> dict[str, UInt8]:
    """Render the initial view of each mode."""
    outlines = framing(scene)
    images = {}
    for mode, (source, target) in scene.layers.items():
        has_normals = source.normals is not None and target.normals is not None
        combined = replace(
            source,
            points=np.concatenate([source.points, target.points]),
            colors=np.concatenate([source.colors, target.colors]),
            normals=np.concatenate([source.normals, target.normals]) if has_normals else None,
            spacing=max(source.spacing, target.spacing),
        )
        eye = _fit_eye(outlines[mode], thumbnails.view_rotation(scene.yaw, scene.pitch), _SIZE)
        images[mode] = render(
            combined,
            _SIZE,
            yaw=scene.yaw,
            pitch=scene.pitch,
            eye_at=eye,
            peel=False,
            min_radius=_MIN_POINT_PIXELS,
        )
    return images


def _search_points(frame: Frame) -> CloudFrame:
    """The points of a view, at most `_MAX_SEARCHED`."""
    sampled = random_subset(len(frame), _MAX_SEARCHED)
    normals = None if frame.normals is None else frame.normals[sampled]
    return CloudFrame(0, 0.0, frame.points[sampled], normals, origin=frame.origin)


def _sampled_view(frame: CloudFrame, points: Float64, others: Float64, total: int) -> _SampledView:
    """Subsample a view; `points` (N, 3) are its points in the frame of `others` (M, 3)."""
    sampled = random_subset(len(frame), MAX_POINTS)
    normals = None
    if len(frame) > _NEIGHBOURS:
        normals = normals_at(frame, sampled.astype(np.int64))
    return _SampledView(
        frame.points[sampled].astype(float), normals, distances(points, others, sampled), total
    )


def _is_z_up(local: LocalView) -> bool:
    """Whether z is up: in maps, and with scanners, which measure in all directions."""
    if not isinstance(local.view.frame, CloudFrame):
        return False
    if local.view.format in _Z_UP or local.center.any():
        return True
    return _MIN_BEHIND <= float((local.view.frame.points[:, 2] < 0).mean()) <= 1 - _MIN_BEHIND


def _uniform(color: tuple[int, int, int], count: int) -> UInt8:
    return np.tile(np.array(color, np.uint8), (count, 1))


def _fit_eye(outline: Float64, R: Float64, size: tuple[int, int]) -> tuple[Float64, float]:
    """The point (3,) to look at, and the distance (m), so that an outline fills the image."""
    center = outline.mean(0)
    extent = max(float(np.linalg.norm(np.ptp(outline, axis=0))), 1e-3)
    distance = 1.2 * extent
    focal = np.array([size[1] / size[0], 1.0]) / np.tan(0.35)
    for _ in range(8):
        view = (outline - center) @ R.T
        projected = focal * view[:, :2] / np.maximum(view[:, 2:] + distance, 0.05 * extent)
        low, high = projected.min(0), projected.max(0)
        center = center + ((low + high) / 2 * distance / focal) @ R[:2]
        distance = max(0.3 * extent, distance * (1 + ((high - low) / 2).max() / 0.85) / 2)
    return center, distance


def _round_up(metres: float) -> float:
    """Return the next of 1, 2, 5, 10 ... mm."""
    if not np.isfinite(metres):
        return 1.0
    power = 10.0 ** np.floor(np.log10(metres))
    return float(power * next(k for k in (1, 2, 5, 10) if k * power >= metres * (1 - 1e-9)))
