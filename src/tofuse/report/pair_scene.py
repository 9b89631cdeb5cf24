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
from tofuse.report.packing import normal_bytes, pack, steps_of
from tofuse.report.scene import Scene, extreme_points, random_subset, render, spacing_of
from tofuse.results.pair import LocalView, PairResult

SOURCE, TARGET = (240, 160, 60), (90, 176, 245)
MODES = ("before", "after", "distance")
MAX_POINTS = 45_000  # of each view; about 2 MB for both
_MAX_SEARCHED = 400_000  # of each view, for the search of nearest points
_NEIGHBOURS = 30  # that a surface is fitted to
_FROM_BASE = 0.2  # of viridis: its darkest colours are invisible on a dark background
# The colour bar ends at this multiple of the median distance of points within a number of rms.
_CAP_MEDIANS, _MAX_RMS = 4.0, 10.0
_NONE_CAPS = 4.0  # a point beyond this multiple of the colour bar's end has no counterpart
_FAR = 2.5  # the initial pose is framed separately if it enlarges the scene by more
_Z_UP = ("las", "e57")  # formats of scanners and maps; cameras look along z
_BEHIND = 0.1  # minimum fraction of points behind the origin that excludes a camera
_SIZE = (720, 480)  # of a rendered view, in pixels
_LEAST_PIXELS = 2  # side of a point


@dataclass(frozen=True, eq=False)
class _Shown:
    """A subsampled view in its own local frame, and its distances in m to the other one."""

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
    none_m
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
    none_m: float
    median_m: float
    fraction: float
    layers: dict[str, tuple[Scene, Scene]]
    yaw: float
    pitch: float
    shown: int
    total: int


def pair_scene(result: PairResult) -> PairScene:
    """Subsample both views and compute the distances between them."""
    T = result.found.T_target_source
    source, target = _search_points(result.source.frame), _search_points(result.target.frame)
    theirs = target.points.astype(float)
    ours = se3.transform(T, source.points.astype(float))
    a = _shown(source, ours, theirs, len(result.source.frame))
    b = _shown(target, theirs, ours, len(result.target.frame))
    both = np.concatenate([a.distance, b.distance])
    usual = _MAX_RMS * result.found.rms_m
    near = both[both <= usual] if (both <= usual).any() else both[np.isfinite(both)]
    cap = _round_up(max(_CAP_MEDIANS * float(np.median(near)) if len(near) else 0.0, 1e-3))
    near = both[both <= _NONE_CAPS * cap]
    z_up = any(_is_z_up(view) for view in (result.source, result.target))
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if z_up else np.eye(3)

    def scene(view: _Shown, pose: Float64, colors: UInt8) -> Scene:
        turned = axes @ pose[:3, :3]
        points = view.points @ turned.T + axes @ pose[:3, 3]
        normals = None if view.normals is None else view.normals @ turned.T
        none = np.zeros((0, 4, 4))
        return Scene(
            points, colors, normals, view.total, spacing_of(points), none, none, none,
            np.zeros((0, 2, 3)),
        )  # fmt: skip

    here = np.eye(4)
    blue = scene(b, here, _uniform(TARGET, len(b.points)))
    layers = {
        "before": (scene(a, result.start, _uniform(SOURCE, len(a.points))), blue),
        "after": (scene(a, T, _uniform(SOURCE, len(a.points))), blue),
        "distance": (
            scene(a, T, distance_colors(a.distance, cap)),
            scene(b, here, distance_colors(b.distance, cap)),
        ),
    }
    return PairScene(
        cap,
        _NONE_CAPS * cap,
        float(np.median(near)) if len(near) else float("nan"),
        len(near) / max(len(both), 1),
        layers,
        *((-0.5, 0.7) if z_up else (-0.3, 0.3)),
        shown=len(a.points) + len(b.points),
        total=a.total + b.total,
    )


def distance_colors(distance: Float64, cap_m: float) -> UInt8:
    """Return colours (N, 3) of distances in m; grey for points without a counterpart."""
    fraction = np.clip(distance / cap_m, 0, 1)
    colors = thumbnails.viridis(_FROM_BASE + (1 - _FROM_BASE) * fraction)
    colors[distance > _NONE_CAPS * cap_m] = thumbnails.GONE
    return colors


def color_bar() -> str:
    """Return the colour bar as a CSS gradient."""
    stops = thumbnails.viridis(np.linspace(_FROM_BASE, 1, 9))
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
    _, own = cKDTree(points).query(points[chosen], k=_NEIGHBOURS)
    means = points[own].mean(1)
    # The neighbours of the nearest point form a patch even at an edge, those of the query may not.
    tree = cKDTree(others)
    _, nearest = tree.query(means)
    _, near = tree.query(others[nearest], k=_NEIGHBOURS)
    group = others[near]
    middle = group.mean(1)
    around = group - middle[:, None]
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    step = means - middle
    off = np.abs((step * vectors[..., 0]).sum(1))
    aside = np.sqrt(np.maximum((step**2).sum(1) - off**2, 0))
    reach = np.sqrt((around**2).sum(2).max(1))
    return np.where(aside <= reach, off, np.inf)


def packed(scene: PairScene) -> dict[str, Any]:
    """Return the scene for the viewer: plain data, arrays as `pack` packs them."""
    arrays: dict[str, str] = {}
    layers = []
    for mode in MODES:
        for view, layer in zip(("source", "target"), scene.layers[mode], strict=True):
            low = layer.points.min(0)
            extent = np.maximum(np.ptp(layer.points, axis=0), 1e-6)
            # "after" and "distance" share their arrays.
            place = view if view == "target" or mode != "before" else "start"
            if place not in arrays:
                arrays[place] = pack(steps_of(layer.points, low, extent))
                if layer.normals is not None:
                    arrays[f"{place} normals"] = pack(normal_bytes(layer.normals))
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
                    "points": place,
                    "normals": f"{place} normals" if layer.normals is not None else None,
                    "colors": colors,
                    "color": list(SOURCE if view == "source" else TARGET),
                }
            )
    seen = framing(scene)
    whole = np.stack([seen["after"].min(0), seen["after"].max(0)])
    return {
        "count": 0,
        "low": whole[0].tolist(),
        "extent": np.ptp(whole, axis=0).tolist(),
        "center": whole.mean(0).tolist(),
        "size": max(float(np.linalg.norm(np.ptp(whole, axis=0))), 1e-3),
        "outlines": {mode: np.round(points, 4).tolist() for mode, points in seen.items()},
        "spacing": 0.01,
        "yaw": scene.yaw,
        "pitch": scene.pitch,
        "model": None,
        "lines": {},
        "arrays": arrays,
        "layers": layers,
    }


def framing(scene: PairScene) -> dict[str, Float64]:
    """Return the extreme points (K, 3) of each mode: common ones, unless the start is far away."""
    after = np.concatenate([extreme_points(layer.points) for layer in scene.layers["after"]])
    before = np.concatenate([extreme_points(layer.points) for layer in scene.layers["before"]])
    both = np.concatenate([after, before])
    if np.linalg.norm(np.ptp(both, axis=0)) <= _FAR * np.linalg.norm(np.ptp(after, axis=0)):
        return dict.fromkeys(MODES, both)
    return {"before": before, "after": after, "distance": after}


def render_modes(scene: PairScene) -> dict[str, UInt8]:
    """Render the initial view of each mode."""
    seen = framing(scene)
    out = {}
    for mode, (source, target) in scene.layers.items():
        have = source.normals is not None and target.normals is not None
        both = replace(
            source,
            points=np.concatenate([source.points, target.points]),
            colors=np.concatenate([source.colors, target.colors]),
            normals=np.concatenate([source.normals, target.normals]) if have else None,
            spacing=max(source.spacing, target.spacing),
        )
        eye = _fit_eye(seen[mode], thumbnails.view_rotation(scene.yaw, scene.pitch), _SIZE)
        out[mode] = render(
            both,
            _SIZE,
            yaw=scene.yaw,
            pitch=scene.pitch,
            eye_at=eye,
            peel=False,
            least=_LEAST_PIXELS,
        )
    return out


def _search_points(frame: Frame) -> CloudFrame:
    """The points of a view, at most `_MAX_SEARCHED`."""
    keep = random_subset(len(frame), _MAX_SEARCHED)
    normals = None if frame.normals is None else frame.normals[keep]
    return CloudFrame(0, 0.0, frame.points[keep], normals, origin=frame.origin)


def _shown(frame: CloudFrame, here: Float64, others: Float64, total: int) -> _Shown:
    """Subsample a view; `here` (N, 3) are its points in the frame of `others` (M, 3)."""
    keep = random_subset(len(frame), MAX_POINTS)
    normals = None
    if len(frame) > _NEIGHBOURS:
        normals = normals_at(frame, keep.astype(np.int64))
    return _Shown(frame.points[keep].astype(float), normals, distances(here, others, keep), total)


def _is_z_up(local: LocalView) -> bool:
    """Whether z is up: in maps, and with scanners, which see in all directions."""
    if not isinstance(local.view.frame, CloudFrame):
        return False
    if local.view.format in _Z_UP or local.center.any():
        return True
    return _BEHIND <= float((local.view.frame.points[:, 2] < 0).mean()) <= 1 - _BEHIND


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
        seen = focal * view[:, :2] / np.maximum(view[:, 2:] + distance, 0.05 * extent)
        low, high = seen.min(0), seen.max(0)
        center = center + ((low + high) / 2 * distance / focal) @ R[:2]
        distance = max(0.3 * extent, distance * (1 + ((high - low) / 2).max() / 0.85) / 2)
    return center, distance


def _round_up(metres: float) -> float:
    """Return the next of 1, 2, 5, 10 ... mm."""
    if not np.isfinite(metres):
        return 1.0
    power = 10.0 ** np.floor(np.log10(metres))
    return float(power * next(k for k in (1, 2, 5, 10) if k * power >= metres * (1 - 1e-9)))
