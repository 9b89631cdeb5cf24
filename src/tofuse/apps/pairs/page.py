"""`report.html` of one registered pair: the pose, and both registered views in 3D."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tofuse.apps.pairs import pair_words
from tofuse.apps.pairs.result import PairResult
from tofuse.apps.report import fields, html, scene, thumbnails, words
from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.geometry import se3
from tofuse.engine.icp import surface_shape

COLORS = {"source": (240, 160, 60), "target": (90, 176, 245)}
MAX_POINTS = 45_000  # of each view; about 1 MB for both
_NEIGHBOURS = 30  # points of a local plane fit
_MEDIANS_PER_CAP = 4.0  # the colour bar ends at this multiple of the median distance
_OUTER = 2.0  # percentage at each end out of view: views thin out with the distance, unlike models
_MAX_SPACINGS = 3.0  # of a point from its counterpart, along the surface


def write_pair_report(result: PairResult, path: Path) -> None:
    """Write the page to `path`.

    Raises
    ------
    OutputError
        If the file can't be written; an earlier one is unchanged then.
    """
    views = {"source": result.source, "target": result.target}
    source, target = (Path(v.name).name or v.name for v in views.values())
    drawn, field = pair_scene(result)
    html.write_page(
        path,
        "pair.html.j2",
        title=f"{source} registered to {target}",
        script=html.script(),
        result=result,
        decision=pair_words.decision(result),
        rotation=pair_words.rotation(result).split(" about ")[0],
        sigma=pair_words.sigma(result),
        moved_m=float(np.linalg.norm(result.moved_m)),
        scene=scene.packed(drawn) | {"fields": {field.name: field.packed()}},
        still=thumbnails.data_uri(scene.render(drawn, yaw=scene.opening_yaw(drawn))),
        colors={name: thumbnails.css(color) for name, color in COLORS.items()},
        thinned=words.thinned(len(drawn.points), drawn.total, "points"),
        lines=pair_words.lines(result),
        rows=[
            (name, v.path, str(v.index), v.format, f"{len(v.frame):,}") for name, v in views.items()
        ],
    )


def pair_scene(result: PairResult) -> tuple[scene.Scene, fields.Field]:
    """Return both views, registered, y down, and the distance of each point from the other view."""
    points, normals = [], []
    views = (result.source.frame, result.target.frame)
    poses = (result.registration.T_target_source, np.eye(4))
    axes = _upright(views, poses)
    for frame, T in zip(views, poses, strict=True):
        chosen = scene.random_subset(len(frame), MAX_POINTS)
        points.append(se3.transform(axes @ T, frame.points[chosen].astype(float)))
        directions = np.zeros((len(chosen), 3))
        if len(frame) > _NEIGHBOURS:
            cloud = CloudFrame(0, 0.0, frame.points, frame.normals, origin=frame.origin)
            directions = surface_shape.normals_at(cloud, chosen.astype(np.int64))
        normals.append(directions @ (axes @ T)[:3, :3].T)
    spacing = max(map(scene.spacing_of, points))
    drawn = scene.Scene(
        np.concatenate(points),
        np.repeat(np.array([*COLORS.values()], np.uint8), [len(p) for p in points], axis=0),
        np.concatenate(normals),
        sum(map(len, views)),
        spacing,
        outer=_OUTER,
    )
    reach = _MAX_SPACINGS * spacing
    distance = np.concatenate(
        [distances(points[a], points[b], normals[b], reach) for a, b in ((0, 1), (1, 0))]
    )
    median = float(np.nan_to_num(np.median(distance))) if len(distance) else 0.0
    cap = max(_MEDIANS_PER_CAP * median, 1e-3)
    ticks = ("0", quantities.length(cap / 2), quantities.length(cap))
    label = "Distance to the other view"
    return drawn, fields.Field("distance", label, distance, 0.0, cap, ticks, (0.0, cap))


def _upright(views: Sequence[Frame], poses: Sequence[Float64]) -> Float64:
    """Return the pose (4, 4) of upright axes, y down, by the up direction of a view."""
    for frame, T in zip(views[::-1], poses[::-1], strict=True):
        up = frame.likely_up if isinstance(frame, CloudFrame) else None
        if up is not None:
            down = -T[:3, :3] @ up
            across = np.cross(down, np.eye(3)[1 if abs(down[1]) < 0.9 else 2])
            across /= np.linalg.norm(across)
            return se3.pose(np.stack([across, down, np.cross(across, down)]))
    return np.eye(4)


def distances(points: Float64, others: Float64, normals: Float64, reach: float) -> Float64:
    """Return distances (N,) in m of points (N, 3) from the planes of the nearest others (M, 3).

    Farther along the surface than `reach` there is no counterpart: the distance to the point.
    """
    from scipy.spatial import cKDTree

    if not len(others):
        return np.full(len(points), np.inf)
    length, nearest = cKDTree(others).query(points)
    along_normal = np.abs(((points - others[nearest]) * normals[nearest]).sum(1))
    beside = length**2 - along_normal**2 > reach**2
    return np.where(beside | ~normals[nearest].any(1), length, along_normal)
