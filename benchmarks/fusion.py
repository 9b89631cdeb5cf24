"""Accuracy and completeness of the fused surface, and cost of fusion.

The simulated room is recorded by the SR4000, by default with noise, mixed pixels, phase wraps and
saturation only (`--all`: with all errors of the camera). Views are fused at the true poses, and
(`--estimated`) at those of the default method; errors are distances to the true surface.
Completeness is the fraction of the true surface within 1 cm of the model: of the surface seen by
valid pixels (this camera outputs noise where the signal is too weak), and of that kept by the
filters. If Open3D is installed, its fusion gets the same filtered frames and poses and the same
voxel size; results are for surfaces with a weight of one and of three views. The pass over the
views is then repeated, to see whether the cost per frame is constant in a volume that is already
filled. Times are CPU times on one thread.

`--frames` prints instead the cost per frame and the memory of the stored views, as more and more
frames of one room are added. With `--memory`, `--frames` frames of one walk through the flat are
fused within several memory limits, each in its own process: number of regions, peak memory before
fusion and in total, and a digest of the surface.

    python benchmarks/fusion.py [--every 1] [--all] [--estimated] [--repeat 4] [--frames 5000]
    python benchmarks/fusion.py --memory 600 200 50 10 --frames 400
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import multiprocessing
import pickle
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.compute.spill import Spill
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.filters.base import apply_filters
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.fusion.layout import Layout
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.fusion.model import ModelBuilder
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.fusion.range_view import RangeView, StoredViews
from tofuse.engine.fusion.tsdf import Volume, fitting_voxel, fuse_surface
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import unit_rays
from tofuse.engine.mapping.config import Config
from tofuse.engine.mapping.mapper import Mapper
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.sensor.multipath_correction import Multipath
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.lab.experiments.surface_error import Surface, compare_surfaces, distances
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import RecordingPlan, plan

_NOISE = Effects.none(shot_noise=True, ambient=1.0, saturation=True, mixed_pixels=True, wrap=True)
_NOISE_FRACTION = 0.01  # of the range
_ELSEWHERE = np.repeat([0.05, 0.03], 3)  # deviation from the path, m and rad
_CELL_M = 0.01  # one observed point is kept in each cell


def simulated(every: int, everything: bool) -> tuple[RecordingPlan, list[RangeFrame]]:
    """The plan and its frames, after factory correction."""
    made = plan("room", effects=Effects() if everything else _NOISE)
    made = replace(made, raw=made.raw[::every])
    return made, [*made.corrected_frames()]


def seen_by(made: RecordingPlan, masks: list[Bool], frames: list[RangeFrame]) -> Float64:
    """True surface points (N, 3) of the pixels in the masks, one per cell."""
    seen = []
    rate = made.sequence.frame_rate_hz
    for raw, T_world, mask, frame in zip(made.raw, made.poses, masks, frames, strict=True):
        T = made.sequence.T_room_camera(raw / rate)
        d = unit_rays(frame.camera.rays()[mask])
        hits = made.scene.cast(T[:3, 3], d @ T[:3, :3].T)
        points = se3.transform(T_world, d * hits.distance[:, None].astype(float))
        seen.append(points[np.isfinite(points).all(1)])
    points = np.concatenate(seen)
    _, first = np.unique(np.floor(points / _CELL_M).astype(np.int64), axis=0, return_index=True)
    return points[first]


def method(everything: bool) -> Config:
    """The default method, without multipath compensation if there is no multipath."""
    config = from_method("default")
    corrections = (c for c in config.corrections if everything or not isinstance(c, Multipath))
    return replace(config, corrections=tuple(corrections))


def views_of(
    frames: list[RangeFrame], config: Config
) -> tuple[list[RangeView], list[Bool], list[RangeFrame]]:
    """Stored views, masks of the pixels that pass the filters, and the corrected frames."""
    correctors = [correction.start() for correction in config.corrections]
    views, masks, corrected = [], [], []
    for frame in frames:
        for corrector in correctors:
            frame = corrector.apply(frame)
        surface = prepare_view(frame, SurfaceOptions())
        clean, _ = apply_filters(config.model_filters, frame, ())
        assert isinstance(clean, RangeFrame)
        views.append(RangeView.of(clean, surface))
        masks.append(clean.valid)
        corrected.append(frame)
    return views, masks, corrected


def shape_of(mesh: Mesh) -> Surface:
    """The mesh as a surface for comparison."""
    return Surface(mesh.vertices, mesh.faces)


def row(label: str, shape: Surface, truth: Surface, seen: Float64, kept: Float64) -> str:
    """One line of the table."""
    found = compare_surfaces(shape, truth, visible=kept)
    recall = (distances(seen, shape) <= found.threshold_m).mean()
    return (
        f"{label:<16} {1e3 * found.accuracy_m:7.1f} {1e3 * found.accuracy_median_m:7.1f} "
        f"{1e3 * found.accuracy_p95_m:7.1f} {100 * found.precision:7.1f} {100 * recall:9.1f} "
        f"{100 * found.recall:9.1f} {100 * found.fscore:7.1f} {100 * found.outliers:8.3f} "
        f"{len(shape.faces) if shape.faces is not None else 0:9,}"
    )


def around_the_room(
    count: int, seed: int = 0, *, scene: str = "room", step: int = 1
) -> Iterator[tuple[RangeFrame, Float64]]:
    """Frames with their poses: laps through a simulated scene, each on a slightly different path.

    Ranges are exact except for independent noise of 1 %: rendering every frame with all camera
    effects would take hours.
    """
    made = plan(scene)
    camera = made.model.camera
    shape = camera.rays().shape[:2]
    rays = unit_rays(camera.rays().reshape(-1, 2))
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        time_s = made.raw[step * k % len(made.raw)] / made.sequence.frame_rate_hz
        T = made.sequence.T_room_camera(time_s) @ se3.exp(rng.normal(0, _ELSEWHERE))
        ranges = made.scene.cast(T[:3, 3], rays @ T[:3, :3].T).distance.reshape(shape)
        noisy = ranges * (1 + _NOISE_FRACTION * rng.standard_normal(shape))
        depth = np.where(np.isfinite(ranges), noisy, 0).astype(np.float32)
        yield RangeFrame(k, k / made.sequence.frame_rate_hz, camera, depth, "range"), T


def long_run(count: int) -> None:
    """Print the cost per view of one room as the number of views grows."""
    builder = ModelBuilder(Fusion())
    poses: dict[int, Float64] = {}
    marks = {round(count * fraction) for fraction in (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)}
    kept_s: list[float] = []
    print(
        f"{'frames':>7} {'views':>6} {'store ms/view':>16} "
        f"{'fuse ms/view':>15} {'fuse ms/frame':>16} {'vertices':>9} {'peak MB':>8}"
    )
    for frame, T in around_the_room(count):
        poses[frame.index] = T
        surface = prepare_view(frame, SurfaceOptions())
        started = time.process_time()
        builder.add(frame, surface, 0)
        kept_s.append(time.process_time() - started)
        if len(poses) not in marks:
            continue
        started = time.process_time()
        model = builder.fuse(poses)
        fused_s = time.process_time() - started
        assert model.mesh is not None
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        print(
            f"{len(poses):>7} {builder.views:>6} "
            f"{1e3 * np.median(kept_s):>16.2f} {1e3 * fused_s / builder.views:>15.2f} "
            f"{1e3 * fused_s / len(poses):>16.2f} {len(model.mesh):>9,} {peak:>8.0f}",
            flush=True,
        )
        kept_s = []


def memories(count: int, bounds: list[int]) -> None:
    """Print the cost of fusing one walk through the flat within several memory limits."""
    step = max(1, len(plan("flat").raw) // count)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames"
        with path.open("wb") as file:
            for pair in around_the_room(count, scene="flat", step=step):
                pickle.dump(pair, file)
        print(
            f"{'memory_mb':>9} {'blocks':>8} {'regions':>8} {'views MB':>9} {'on disk':>8} "
            f"{'CPU s':>7} {'vertices':>9} {'before MB':>10} {'peak MB':>8}  surface"
        )
        for bound in bounds:
            # A process each: peak memory is that of the process, not of the call.
            spawned = multiprocessing.get_context("spawn").Process(
                target=within, args=(path, count, bound)
            )
            spawned.start()
            spawned.join()


def within(path: Path, count: int, memory_mb: int) -> None:
    """Fuse the frames of a file within a memory limit, and print the cost."""
    options = Fusion(memory_mb=memory_mb)
    store: Spill[RangeView] = Spill(memory_mb * 500_000)
    views = StoredViews(store)
    poses = []
    with threads(1), path.open("rb") as file:
        for _ in range(count):
            frame, T = pickle.load(file)
            views.add(RangeView.of(frame, prepare_view(frame, SurfaceOptions())))
            poses.append(T)
        T_world = np.array(poses)
        layout = Layout.of(views, T_world, fitting_voxel(views))
        regions = len(layout.regions(memory_mb * 1_000_000 // layout.block_bytes))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        started = time.process_time()
        mesh = fuse_surface(views, T_world, options)
        cpu_s = time.process_time() - started
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    columns = (mesh.vertices, mesh.faces, mesh.normals, mesh.sigma, mesh.views)
    digest = hashlib.sha256(b"".join(each.tobytes() for each in columns)).hexdigest()[:8]
    print(
        f"{memory_mb:>9} {len(layout.keys):>8,} {regions:>8} {store.nbytes / 1e6:>9.0f} "
        f"{store.spilled_bytes / 1e6:>8.0f} {cpu_s:>7.1f} {len(mesh):>9,} {before:>10.0f} "
        f"{peak:>8.0f}  {digest}",
        flush=True,
    )


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--all", action="store_true", help="all errors of the camera")
    parser.add_argument("--estimated", action="store_true", help="also at estimated poses")
    parser.add_argument("--repeat", type=int, default=4)
    parser.add_argument("--frames", type=int, help="only the cost of this many frames of one room")
    parser.add_argument(
        "--memory", type=int, nargs="+", help="memory limits, MB, for frames of the flat"
    )
    options = parser.parse_args(arguments)
    if options.memory:
        memories(options.frames or 400, options.memory)
        return 0
    if options.frames:
        with threads(1):
            long_run(options.frames)
        return 0
    made, frames = simulated(options.every, options.all)
    vertices, faces = made.scene.truth_mesh()
    T_world_truth = made.sequence.T_world_truth(made.raw[0] / made.sequence.frame_rate_hz)
    truth = Surface(se3.transform(T_world_truth, vertices), faces)
    config = method(options.all)
    views, masks, corrected = views_of(frames, config)
    seen = seen_by(made, [frame.valid for frame in frames], frames)
    kept = seen_by(made, masks, frames)
    print(f"{len(frames)} frames; {len(seen):,} cm^3 with surface seen, {len(kept):,} kept")
    print(
        f"{'poses':<16} {'mean mm':>7} {'median':>7} {'95 %':>7} {'<1cm %':>7} {'of seen %':>9} "
        f"{'of kept %':>9} {'F':>7} {'>5cm %':>8} {'faces':>9}"
    )
    print(row("true", shape_of(fuse_surface(views, made.poses)), truth, seen, kept), flush=True)
    if importlib.util.find_spec("open3d"):
        from peers import o3d

        clean = [frame.keep(mask) for frame, mask in zip(corrected, masks, strict=True)]
        for min_weight in (1.0, 3.0):
            peer = Surface(*o3d.fused(clean, made.poses, fitting_voxel(views), min_weight))
            print(row(f"Open3D, weight {min_weight:.0f}", peer, truth, seen, kept), flush=True)
    if options.estimated:
        mapper = Mapper(config)
        for frame in frames:
            mapper.push(frame)
        result = mapper.finish()
        assert result.mesh is not None
        print(row("estimated", shape_of(result.mesh), truth, seen, kept))
        seconds = result.diagnostics.seconds["fusion"]
        print(f"fusion took {1e3 * seconds / len(frames):.0f} ms/frame in total")
    with threads(1):
        layout = Layout.of(views, made.poses, fitting_voxel(views))
        volume = Volume.of(layout, layout.single_region())
        print(f"voxels of {1e3 * volume.voxel_m:.1f} mm, {len(volume.keys):,} blocks")
        for turn in range(options.repeat):
            started = time.process_time()
            volume.add(views, made.poses)
            cpu_s = time.process_time() - started
            print(f"pass {turn + 1}: {1e3 * cpu_s / len(views):.1f} ms/frame")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"peak memory {peak:.0f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
