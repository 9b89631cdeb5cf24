"""Mirrors of a finished reconstruction, and the model without what is behind mirrors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tofuse.apps.mirrors.openings import Opening, find_openings, find_planes
from tofuse.apps.mirrors.reflection import Evidence, weigh
from tofuse.apps.mirrors.views import Noise, View, views_of, with_too_short
from tofuse.engine.arrays import Bool, Float32, Float64
from tofuse.engine.frames import Recording, evenly_spaced
from tofuse.engine.fusion import Cloud
from tofuse.engine.results import Mirror, Reconstruction

# A mirror is this much likelier than chance (logarithm), or so much where it is not surrounded by
# surface, as most such openings are none; and it agrees in this share of its pixels.
_MIN_LOG_RATIO, _MIN_LOG_RATIO_FRAYED, _MIN_SHARE = 7.0, 20.0, 0.3
# Points that predict, views of a first look, and the smallest share there for a second one.
_POINTS, _FIRST_LOOK, _PROMISING = 30_000, 10, 0.2
# Planes of several surfaces are none: half of the tilt at which a mirror is a wrong one.
_MAX_TILT_RAD = 0.1
_ORIGINS = 300  # cameras from which points behind a mirror may be seen
_MAX_GROWTH = 1.25  # of the area, by joining parts of one mirror


def find_mirrors(recording: Recording, result: Reconstruction, seed: int = 0) -> Reconstruction:
    """Return the result with its mirrors, and without the points and faces behind them.

    Parameters
    ----------
    recording
        The recording that it was made of; some frames are read again.
    result
        A reconstruction of range images; others have no mirrors.
    seed
        Of the sampling.
    """
    views = views_of(recording, result) if result.has_pose.any() else []
    cloud = result.cloud
    if not views or cloud.normals is None or not len(cloud):
        return result
    points, normals = cloud.points.astype(np.float64), cloud.normals.astype(np.float64)
    noise = Noise.of(views, points)
    views = with_too_short(views, 2 * noise.tolerance_m)
    rng = np.random.default_rng([seed, 17])
    planes = find_planes(points, normals, noise.tolerance_m, rng)
    chosen = rng.permutation(len(points))[:_POINTS]
    points, normals = points[chosen], normals[chosen]
    path = result.trajectory[result.has_pose, :3, 3]
    found = []
    for plane in planes:
        weighed = [
            (opening, _weighed(opening, views, points, normals, noise))
            for opening in find_openings(plane, views, noise)
            if opening.tilt_rad(points, normals, 2 * noise.tolerance_m) < _MAX_TILT_RAD
            and not opening.crossed_by(path)
        ]
        found += _mirrors_in(weighed)
    found.sort(key=lambda item: -item[1].log_ratio)
    return _applied(result, views, noise, found)


_Found = tuple[Opening, Evidence]


def _weighed(
    opening: Opening, views: Sequence[View], points: Float64, normals: Float64, noise: Noise
) -> Evidence:
    views = [view for view in views if opening.seen_by(view, 2 * noise.tolerance_m)]
    step = max(1, len(views) // _FIRST_LOOK)
    first = weigh(opening, views[::step], points, normals, noise, compare=False)
    if step > 1 and first.patches and first.share < _PROMISING:
        return first
    return weigh(opening, views, points, normals, noise)


def _mirrors_in(weighed: Sequence[tuple[Opening, Evidence]]) -> list[_Found]:
    """Select the mirrors in a plane; their parts that reflect too little to tell join them."""
    accepted: list[_Found] = []
    for opening, evidence in sorted(weighed, key=lambda item: -item[1].log_ratio):
        if evidence.share < _MIN_SHARE:
            continue
        for k, (other, known) in enumerate(accepted):
            joined = other.joined(opening)
            if joined.area_m2 < _MAX_GROWTH * (other.area_m2 + opening.area_m2):
                accepted[k] = joined, known
                break
        else:
            needed = _MIN_LOG_RATIO if opening.whole else _MIN_LOG_RATIO_FRAYED
            if evidence.log_ratio > needed:
                accepted.append((opening, evidence))
    return accepted


def _applied(
    result: Reconstruction, views: Sequence[View], noise: Noise, found: Sequence[_Found]
) -> Reconstruction:
    """Add mirrors to a result, the likeliest first, and remove what is behind them."""
    origins = result.trajectory[evenly_spaced(np.flatnonzero(result.has_pose), _ORIGINS), :3, 3]
    cloud, mesh = result.cloud, result.mesh
    mirrors: list[Mirror] = []
    margin = 2 * noise.tolerance_m
    taken: list[Opening] = []
    for opening, evidence in found:
        centre = opening.corners.mean(0)[None]
        if any(_same_place(other, centre, origins, margin) for other in taken):
            continue
        through = _through(opening, cloud.points, origins, margin)
        behind, room = _behind(opening, cloud.points, through, views, margin)
        if room:
            continue
        taken.append(opening)
        seen = cloud.points[behind]
        cloud = _kept(cloud, ~behind)
        if mesh is not None:
            through = _through(opening, mesh.vertices, origins, margin)
            inside = ~_behind(opening, mesh.vertices, through, views, margin)[0]
            mesh = mesh.rows(np.asarray(inside[mesh.faces].all(1), np.bool_))
        mirrors.append(
            Mirror(
                opening.plane.normal,
                opening.plane.offset,
                opening.corners,
                opening.area_m2,
                evidence.share,
                evidence.log_ratio,
                seen,
            )
        )
    return replace(result, cloud=cloud, mesh=mesh, mirrors=tuple(mirrors))


def _same_place(known: Opening, centre: Float64, origins: Float64, margin: float) -> bool:
    """Whether an opening's centre (1, 3) is in a known one, or in the room behind it."""
    height = known.plane.height(centre)
    in_it = abs(height) < margin and known.contains(centre - height[:, None] * known.plane.normal)
    return bool(in_it or known.behind(centre, origins)[0])


def _through(opening: Opening, points: Float32, origins: Float64, margin: float) -> Bool:
    """Which points (N, 3) behind the plane are seen through an opening."""
    rows = np.flatnonzero(opening.plane.height(points.astype(np.float64)) < -margin)
    out = np.zeros(len(points), bool)
    out[rows] = opening.grown(margin).behind(points[rows].astype(np.float64), origins)
    return out


def _behind(
    opening: Opening, points: Float32, through: Bool, views: Sequence[View], margin: float
) -> tuple[Bool, bool]:
    """Which points (N, 3) are seen through an opening only, and whether it is a room's.

    Views from behind the plane measure the points of a room there, but not what a mirror shows.
    """
    rows = np.flatnonzero(through)
    looked, measured = np.zeros((2, len(rows)), bool)
    for view in views:
        if opening.plane.height(view.origin) > -margin or not len(rows):
            continue
        beyond = view.beyond(points[rows].astype(np.float64))
        looked |= beyond > -margin
        measured |= np.abs(beyond) < margin
    out = through.copy()
    out[rows] = ~measured
    return out, bool(measured.sum() > 0.5 * looked.sum())


def _kept(cloud: Cloud, rows: Bool) -> Cloud:
    def of(column: np.ndarray | None) -> np.ndarray | None:
        return None if column is None else column[rows]

    return Cloud(
        cloud.points[rows], of(cloud.normals), of(cloud.color), cloud.views[rows], of(cloud.sigma)
    )


def sentences(result: Reconstruction) -> list[str]:
    """Return a sentence for each mirror."""
    return [
        f"Mirror of {m.area_m2:.2f} m² at "
        f"({', '.join(f'{x:.2f}' for x in m.corners.mean(0))}) m: "
        f"{len(m.points):,} points seen in it were cut out of the model."
        for m in result.mirrors
    ]
