"""Two views: registration success over initial error, overlap, noise and outliers."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

import pairs
from boards import Board, Score, default_made
from cloud_kinds import OBJECT_M
from peers import kiss_global, o3d_global
from tofuse.engine.alignment.base import Registrar
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras.cameras import ray_lengths
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import CloudFrame, Frame, RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.coarse_to_fine import spacing
from tofuse.engine.icp.icp import Icp
from tofuse.engine.icp.icp_parts import All, MaxDistance, Random, SmallStep

# Errors of the initial guess, m and degrees.
STARTS = ((0.02, 1.0), (0.1, 5.0), (0.2, 10.0), (0.4, 20.0), (0.8, 40.0))
NEAR = (0.05, 2.0)
NOISE_M = (0.01, 0.03)
OUTLIERS = (0.1, 0.3)
APART = (2, 4)
SCENES = ("room", "flat", "rail", "torso", "kitchen")
# Tolerance of a right pose: fraction of the median depth, and degrees.
RIGHT_FRACTION, RIGHT_DEG = 0.02, 1.5
POINTS = 1000
_SEED = 7  # of the benchmark's own random numbers


@dataclass(frozen=True)
class _Peer(Registrar):
    """Registration by another program."""

    align: Callable[[Float64, Float64, Float64, float], Float64]
    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})


class TwoViews(Board):
    """See `Board`."""

    name = "pairs"
    title = "Two views"
    columns: ClassVar[dict[str, str]] = {
        **{f"start{k}": f"initial error {m:g} m, {d:g} deg" for k, (m, d) in enumerate(STARTS)},
        **{f"apart{k}": f"gap of {k} views" for k in APART},
        **{f"noise{s:g}": f"added noise {1000 * s:g} mm" for s in NOISE_M},
        **{f"outliers{s:g}": f"{100 * s:g} % outliers" for s in OUTLIERS},
    }

    def methods(self) -> Sequence[str]:
        """See `Board`: registrations, and ICP with each of the metrics and matchers."""
        made = default_made("registration")
        metrics = default_made("metric")
        matchers = default_made("matcher")
        return [
            *made,
            *(f"icp, {name}" for name in metrics if name not in made),
            *(f"icp, {name}" for name in matchers),
            *peers(),
        ]

    def cases(self, seeds: int) -> Sequence[str]:
        """See `Board`."""
        return [
            f"{group}/{scene}/{seed}"
            for group in self.columns
            for scene in SCENES
            for seed in range(seeds)
        ]

    def prepare(self, data: Path) -> None:
        """See `Board.prepare`."""
        for scene in SCENES:
            _recording(scene, data)

    def run(self, method: str, case: str, data: Path) -> Score | None:
        """See `Board`."""
        group, scene, seed = case.split("/")
        found = views(group, scene, int(seed), data)
        if found is None:
            return None
        source, target, true, guess = found
        registrar = registration(method, max(spacing(source), spacing(target)))
        cloud = isinstance(registrar, _Peer) or "range" not in registrar.takes
        a, b = (_as_cloud(v) if cloud else v for v in (source, target))
        rng = np.random.default_rng([_SEED, int(seed)])
        began = time.process_time()
        try:
            if isinstance(registrar, _Peer):
                unit = max(spacing(a), spacing(b))
                T = registrar.align(a.points.astype(float), b.points.astype(float), guess, unit)
            else:
                T = registrar.register(a, b, guess, rng).T_target_source
        except RegistrationError:
            T = np.full((4, 4), np.nan)
        seconds = time.process_time() - began
        centre = np.median(source.points, 0)[None].astype(float)
        error = np.linalg.norm(se3.transform(T, centre) - se3.transform(true, centre))
        angle = (
            np.degrees(se3.angle((se3.inverse(true) @ T)[:3, :3])) if np.isfinite(error) else 180
        )
        depth = float(np.median(np.linalg.norm(source.points, axis=1)))
        right = bool(error < RIGHT_FRACTION * depth and angle < RIGHT_DEG)
        return {
            "right": float(right),
            "off": float(np.nan_to_num(error, nan=1e3)),
            "degrees": float(angle),
            "seconds": seconds,
        }

    def cell(self, scores: Sequence[Score]) -> str:
        """See `Board`: fraction of right poses, and their median error."""
        right = [s for s in scores if s["right"]]
        text = f"{100 * len(right) / len(scores):.0f} %"
        return f"{text} {1000 * np.median([s['off'] for s in right]):.1f}" if right else text

    def merit(self, scores: Sequence[Score]) -> float:
        """See `Board`."""
        return float(np.mean([s["right"] for s in scores]))


def registration(name: str, resolution: float) -> Registrar:
    """Return a method by its label; its distances are multiples of the point spacing."""
    if name in peers():
        return _Peer(peers()[name])
    plain = Icp(
        resolution,
        source=Random(POINTS),
        target=All(),
        rejectors=(MaxDistance(5.0),),
        stopping=SmallStep(),
    )
    made = default_made("registration")
    if name in made:
        method: Any = made[name]
        sized = {f.name for f in fields(method)} & {"resolution"}
        if sized and method.resolution is not None:
            method = replace(method, resolution=resolution)
        return method  # type: ignore[no-any-return]
    part = name.removeprefix("icp, ")
    metrics = default_made("metric")
    if part in metrics:
        return replace(plain, metric=metrics[part])
    return replace(plain, matcher=default_made("matcher")[part])


def views(
    group: str, scene: str, seed: int, data: Path
) -> tuple[RangeFrame, RangeFrame, Float64, Float64] | None:
    """Source, target, true T_target_source and guess of a case; None where there is no data."""
    recording = _recording(scene, data)
    if recording is None or recording.reference is None:
        return None
    rng = np.random.default_rng([_SEED, SCENES.index(scene), seed])
    first = _apart(scene)
    apart = first * int(group[5:]) if group.startswith("apart") else first
    if apart >= len(recording):
        return None
    i = int(rng.integers(len(recording) - apart))
    target, source = recording[i], recording[i + apart]
    T = recording.reference
    if not np.isfinite(T[[i, i + apart]]).all():
        return None
    assert isinstance(source, RangeFrame)
    assert isinstance(target, RangeFrame)
    true = se3.inverse(T[i]) @ T[i + apart]
    metres, degrees = STARTS[int(group[5:])] if group.startswith("start") else NEAR
    if scene in pairs.OBJECTS:
        source, target = (_object(view) for view in (source, target))
    guess = true @ _about(np.median(source.points, 0).astype(float), metres, degrees, rng)
    for _ in range(2):
        source, target = target, source
        if group.startswith("noise"):
            source = _noisy(source, float(group[5:]), rng)
        elif group.startswith("outliers"):
            source = _with_outliers(source, float(group[8:]), rng)
    return source, target, true, guess


@cache
def _recording(scene: str, data: Path) -> Any:
    known = pairs.SCENES | pairs.OBJECTS
    try:
        return known[scene].open(data)
    except FileNotFoundError:
        return None


def _apart(scene: str) -> int:
    return 10 if scene == "kitchen" else 1


def _about(centre: Float64, metres: float, degrees: float, rng: np.random.Generator) -> Float64:
    """A motion (4, 4) by a length and an angle about the centre of the points."""
    shift, axis = rng.normal(size=(2, 3))
    to, back = np.eye(4), np.eye(4)
    to[:3, 3], back[:3, 3] = centre, -centre
    turn = np.radians(degrees) * axis / np.linalg.norm(axis)
    step = se3.exp(np.r_[0, 0, 0, turn])
    step[:3, 3] = metres * shift / np.linalg.norm(shift)
    return np.asarray(to @ step @ back)


def _object(view: RangeFrame) -> RangeFrame:
    """Remove the background, which does not move with the object."""
    ranges = view.depth * (ray_lengths(view.camera) if view.depth_kind == "z" else 1)
    return view.keep(ranges < OBJECT_M)


def _noisy(view: RangeFrame, sigma: float, rng: np.random.Generator) -> RangeFrame:
    depth = view.depth + (sigma * rng.normal(size=view.depth.shape)).astype(np.float32)
    return replace(view, depth=np.where(view.depth > 0, np.maximum(depth, 0.01), 0))


def _with_outliers(view: RangeFrame, fraction: float, rng: np.random.Generator) -> RangeFrame:
    """Replace a fraction of the pixels by random depths between the nearest and the farthest."""
    good = view.depth > 0
    low, high = np.percentile(view.depth[good], [1, 99])
    wrong = good & (rng.uniform(size=good.shape) < fraction)
    depth = np.where(wrong, rng.uniform(low, high, good.shape), view.depth)
    return replace(view, depth=depth.astype(np.float32))


def _as_cloud(view: Frame) -> CloudFrame:
    return CloudFrame(view.index, view.timestamp, view.points)


@cache
def peers() -> dict[str, Callable[[Float64, Float64, Float64, float], Float64]]:
    """Registrations of other programs that are installed, by name."""
    out: dict[str, Callable[[Float64, Float64, Float64, float], Float64]] = {}
    try:
        o3d = importlib.import_module("open3d")
    except ImportError:
        pass
    else:
        estimation = o3d.pipelines.registration
        for name, way in (
            ("Open3D point-to-point", estimation.TransformationEstimationPointToPoint()),
            ("Open3D point-to-plane", estimation.TransformationEstimationPointToPlane()),
            ("Open3D GICP", estimation.TransformationEstimationForGeneralizedICP()),
        ):
            out[name] = _open3d(o3d, way)
    try:
        small = importlib.import_module("small_gicp")
    except ImportError:
        pass
    else:
        for kind in ("ICP", "PLANE_ICP", "GICP", "VGICP"):
            out[f"small_gicp {kind}"] = _small_gicp(small, kind)
    for name, module in (("Open3D FPFH, RANSAC", o3d_global), ("KISS-Matcher", kiss_global)):
        if module.method(1.0) is not None:
            out[name] = _global(module.method)
    return out


def _global(
    method: Callable[[float], Callable[[Frame, Frame], Float64] | None],
) -> Callable[[Float64, Float64, Float64, float], Float64]:
    """Return a registration that uses no guess; its voxels are a hundredth of the scene."""

    def align(source: Float64, target: Float64, guess: Float64, unit: float) -> Float64:
        clouds = [CloudFrame(k, 0.0, p.astype(np.float32)) for k, p in enumerate((source, target))]
        registered = method(float(np.ptp(target, 0).max()) / 100)
        assert registered is not None
        return registered(*clouds)

    return align


def _open3d(o3d: Any, way: Any) -> Callable[[Float64, Float64, Float64, float], Float64]:
    def align(source: Float64, target: Float64, guess: Float64, unit: float) -> Float64:
        clouds = []
        for points in (source, target):
            cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
            cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(20))
            clouds.append(cloud)
        call = o3d.pipelines.registration.registration_icp
        if "Generalized" in type(way).__name__:
            call = o3d.pipelines.registration.registration_generalized_icp
        end = o3d.pipelines.registration.ICPConvergenceCriteria(max_iteration=50)
        return np.asarray(call(*clouds, 5 * unit, guess, way, end).transformation)

    return align


def _small_gicp(small: Any, kind: str) -> Callable[[Float64, Float64, Float64, float], Float64]:
    def align(source: Float64, target: Float64, guess: Float64, unit: float) -> Float64:
        found = small.align(
            target,
            source,
            guess,
            registration_type=kind,
            downsampling_resolution=unit,
            voxel_resolution=4 * unit,
            max_correspondence_distance=5 * unit,
            num_threads=1,
            max_iterations=50,
        )
        return np.asarray(found.T_target_source)

    return align
