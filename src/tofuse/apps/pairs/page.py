"""`report.html` of one registered pair: the pose, and both views in 3D before and after."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.apps.pairs import pair_words
from tofuse.apps.pairs.result import PairResult
from tofuse.apps.report import html, packing, scene, thumbnails, words
from tofuse.engine.arrays import Float64, Intp, UInt8
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.geometry import se3
from tofuse.engine.icp import surface_shape
from tofuse.formats.recordings import SingleView

COLORS = {"source": (240, 160, 60), "target": (90, 176, 245)}
MODES = {"before": "Before", "after": "After", "distance": "After, by distance"}
MAX_POINTS = 45_000  # of each view; about 2 MB for both
_TONES = {True: "good", False: "failed", None: "degraded"}
_MAX_SEARCHED = 400_000  # points of each view in the nearest-neighbour search
_NEIGHBOURS = 30  # points of a local plane fit
_MIN_COLOR = 0.2  # of viridis, whose darkest colours are invisible on a dark background
# The colour bar ends at this multiple of the median distance of points within a number of rms.
_MEDIANS_PER_CAP, _MAX_RMS = 4.0, 10.0
_UNMATCHED_CAPS = 4.0  # points beyond this multiple of the colour bar's end have no counterpart
_MAX_EXTENT_RATIO = 2.5  # the initial pose is framed separately if it enlarges the scene more
_Z_UP = ("las", "e57")  # formats of scanners and maps; cameras look along z
_MIN_BEHIND = 0.1  # minimum fraction of points behind the origin that excludes a camera


def write_pair_report(result: PairResult, path: Path) -> None:
    """Write the page to `path`.

    Raises
    ------
    OutputError
        If the file can't be written; an earlier one is unchanged then.
    """
    pair = PairScene.of(result)
    source, target = (Path(v.name).name or v.name for v in (result.source, result.target))
    html.write_page(
        path,
        "pair.html.j2",
        title=f"{source} registered to {target}",
        script=html.script(),
        scene=packed(pair),
        verdict=_verdict(result),
        model=_model(pair),
        transform={
            "lines": pair_words.lines(result),
            "rows": [_row("source", result.source), _row("target", result.target)],
        },
    )


def _verdict(result: PairResult) -> dict[str, Any]:
    registration = result.registration
    head, tail = pair_words.decision(result)
    name = "Displacement of the centre" if result.source.frame.shift.any() else "Translation"
    facts = [(name, words.length(float(np.linalg.norm(result.moved_m))))]
    facts.append(("Rotation", pair_words.rotation(result).split(" about ")[0]))
    if registration.overlap is not None:
        facts.append(("Overlap", pair_words.percent(registration.overlap)))
    facts.append(("Rms distance", words.length(registration.rms_m)))
    if result.sigma != (None, None):
        facts.append(("Sigma", pair_words.sigma(result)))
    if registration.margin is not None:
        facts.append(("Margin", pair_words.percent(registration.margin)))
    return {"tone": _TONES[registration.believed], "head": head, "tail": tail, "facts": facts}


def _model(pair: PairScene) -> dict[str, Any]:
    """The controls of the 3D view, its colour bar, and an image of it."""
    stops = thumbnails.viridis(np.linspace(_MIN_COLOR, 1, 9))
    beyond = words.length(pair.max_distance_m)
    distance = f"No point is within {beyond} of the other view."
    matched = pair.matched
    if len(matched):
        fraction = pair_words.percent(len(matched) / len(pair.all_distances))
        distance = (
            f"Median distance {_mm(float(np.median(matched)))}, over the {fraction} of the points "
            f"that are within {beyond} of the other view."
        )
    shown = sum(len(pair.points[view]) for view in COLORS)
    return {
        "modes": MODES,
        "colors": {view: thumbnails.css(color) for view, color in COLORS.items()},
        "none_color": thumbnails.css(thumbnails.NO_MEASUREMENT),
        "bar": f"linear-gradient(to right, {', '.join(map(thumbnails.css, stops.tolist()))})",
        "ticks": [_mm(pair.cap_m * fraction) for fraction in (0, 0.25, 0.5, 0.75, 1)],
        "beyond": beyond,
        "distance": distance,
        "thinned": words.thinned(shown, pair.total, "points"),
        "still": thumbnails.data_uri(still(pair)),
    }


def _row(name: str, view: SingleView) -> tuple[str, ...]:
    return name, view.path, str(view.index), view.format, f"{len(view.frame):,}"


def _mm(metres: float) -> str:
    return f"{1000 * metres:.3g} mm"


@dataclass(frozen=True, eq=False)
class PairScene:
    """The content of the 3D view: both views, subsampled.

    Attributes
    ----------
    points, normals
        (N, 3) m and unit vectors (or None) of "start" and "source", the source at its initial and
        at its final pose, and of "target"; y down.
    distance
        (N,) distances in m of the points of "source" and "target" to the surface of the other.
    cap_m
        Distance at the end of the colour bar.
    total
        Number of points of both, before subsampling.
    yaw, pitch
        Initial viewing direction, rad.
    """

    points: dict[str, Float64]
    normals: dict[str, Float64 | None]
    distance: dict[str, Float64]
    cap_m: float
    total: int
    yaw: float
    pitch: float

    @classmethod
    def of(cls, result: PairResult) -> PairScene:
        """Subsample both views and compute the distances between them."""
        T, views = result.registration.T_target_source, (result.source, result.target)
        source, target = (_search_points(view.frame) for view in views)
        targets = target.points.astype(float)
        sources = se3.transform(T, source.points.astype(float))
        z_up = any(_is_z_up(view) for view in views)
        axes = np.eye(4)
        if z_up:
            axes[1:3, 1:3] = [[0, -1], [1, 0]]
        points: dict[str, Float64] = {}
        normals: dict[str, Float64 | None] = {}
        distance = {}
        for name, frame, own, others, poses in (
            ("source", source, sources, targets, {"start": result.T_start, "source": T}),
            ("target", target, targets, sources, {"target": np.eye(4)}),
        ):
            chosen = scene.random_subset(len(frame), MAX_POINTS)
            distance[name] = distances(own, others, chosen)
            directions = None
            if len(frame) > _NEIGHBOURS:
                directions = surface_shape.normals_at(frame, chosen.astype(np.int64))
            for key, pose in poses.items():
                points[key] = se3.transform(axes @ pose, frame.points[chosen].astype(float))
                R = (axes @ pose)[:3, :3]
                normals[key] = None if directions is None else directions @ R.T
        return cls(
            points,
            normals,
            distance,
            _cap(np.concatenate([*distance.values()]), result.registration.rms_m),
            sum(len(view.frame) for view in views),
            *((-0.5, 0.7) if z_up else (-0.3, 0.3)),
        )

    @property
    def max_distance_m(self) -> float:
        """Distance beyond which a point has no counterpart."""
        return _UNMATCHED_CAPS * self.cap_m

    @property
    def all_distances(self) -> Float64:
        """The distances of the points of both views."""
        return np.concatenate([*self.distance.values()])

    @property
    def matched(self) -> Float64:
        """The distances of the points that have a counterpart."""
        return self.all_distances[self.all_distances <= self.max_distance_m]


def _search_points(frame: Frame) -> CloudFrame:
    """The points of a view, at most `_MAX_SEARCHED`."""
    sampled = scene.random_subset(len(frame), _MAX_SEARCHED)
    normals = None if frame.normals is None else frame.normals[sampled]
    return CloudFrame(0, 0.0, frame.points[sampled], normals, origin=frame.origin)


def _is_z_up(view: SingleView) -> bool:
    """Whether z is up: in maps, and with scanners, which measure in all directions."""
    if not isinstance(view.frame, CloudFrame):
        return False
    if view.format in _Z_UP or view.frame.shift.any():
        return True
    return _MIN_BEHIND <= float((view.frame.points[:, 2] < 0).mean()) <= 1 - _MIN_BEHIND


def _cap(distance: Float64, rms_m: float) -> float:
    """The distance at the end of the colour bar: 1, 2, 5, 10 ... mm."""
    near = distance[distance <= _MAX_RMS * rms_m]
    near = near if len(near) else distance[np.isfinite(distance)]
    metres = max(_MEDIANS_PER_CAP * float(np.median(near)) if len(near) else 0.0, 1e-3)
    power = 10.0 ** np.floor(np.log10(metres))
    return float(power * next(k for k in (1, 2, 5, 10) if k * power >= metres * (1 - 1e-9)))


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


def distance_colors(distance: Float64, cap_m: float) -> UInt8:
    """Return colours (N, 3) of distances in m; grey for points without a counterpart."""
    fraction = np.clip(distance / cap_m, 0, 1)
    colors = thumbnails.viridis(_MIN_COLOR + (1 - _MIN_COLOR) * fraction)
    colors[distance > _UNMATCHED_CAPS * cap_m] = thumbnails.NO_MEASUREMENT
    return colors


def packed(pair: PairScene) -> dict[str, Any]:
    """Return the scene for the viewer: plain data, arrays as `pack` packs them."""
    arrays: dict[str, str] = {}
    placed: dict[str, dict[str, Any]] = {}
    for key, points in pair.points.items():
        low, extent = points.min(0), np.maximum(np.ptp(points, axis=0), 1e-6)
        normals = pair.normals[key]
        arrays[key] = packing.pack(packing.quantized(points, low, extent))
        if normals is not None:
            arrays[f"{key} normals"] = packing.pack(packing.normal_bytes(normals))
        placed[key] = {
            "count": len(points),
            "low": low.tolist(),
            "extent": extent.tolist(),
            "spacing": scene.spacing_of(points),
            "points": key,
            "normals": None if normals is None else f"{key} normals",
        }
    for view, distance in pair.distance.items():
        arrays[f"{view} colors"] = packing.pack(distance_colors(distance, pair.cap_m))
    layers = [
        placed["start" if (mode, view) == ("before", "source") else view]
        | {
            "mode": mode,
            "view": view,
            "colors": f"{view} colors" if mode == "distance" else None,
            "color": color,
        }
        for mode in MODES
        for view, color in COLORS.items()
    ]
    outlines = framing(pair)
    low, high = outlines["after"].min(0), outlines["after"].max(0)
    return {
        "count": 0,
        "low": low.tolist(),
        "extent": (high - low).tolist(),
        "center": ((low + high) / 2).tolist(),
        "size": max(float(np.linalg.norm(high - low)), 1e-3),
        "outlines": {mode: np.round(points, 4).tolist() for mode, points in outlines.items()},
        "spacing": 0.01,
        "yaw": pair.yaw,
        "pitch": pair.pitch,
        "model": None,
        "lines": {},
        "arrays": arrays,
        "layers": layers,
    }


def framing(pair: PairScene) -> dict[str, Float64]:
    """Return the extreme points (K, 3) of each mode: common ones, unless the start is distant."""
    start, source, target = (scene.extreme_points(pair.points[k]) for k in ("start", *COLORS))
    before, after = np.concatenate([start, target]), np.concatenate([source, target])
    combined = np.concatenate([after, before])
    extents = [np.linalg.norm(np.ptp(outline, axis=0)) for outline in (combined, after)]
    if extents[0] <= _MAX_EXTENT_RATIO * extents[1]:
        return dict.fromkeys(MODES, combined)
    return {"before": before, "after": after, "distance": after}


def still(pair: PairScene) -> UInt8:
    """Render both views after registration, for browsers without WebGL."""
    points = np.concatenate([pair.points[view] for view in COLORS])
    normals = [n for view in COLORS if (n := pair.normals[view]) is not None]
    counts = [len(pair.points[view]) for view in COLORS]
    both = scene.Scene(
        points,
        np.repeat(np.array([*COLORS.values()], np.uint8), counts, axis=0),
        np.concatenate(normals) if len(normals) == len(COLORS) else None,
        pair.total,
        max(scene.spacing_of(pair.points[view]) for view in COLORS),
    )
    return scene.render(both, yaw=pair.yaw, pitch=pair.pitch, peel=False, min_radius=2)
