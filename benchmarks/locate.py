"""Localisation in a finished map: frames of sessions that it has not seen, and of other buildings.

The building and the walk are those of `hours.py`. The map is the result of a run on one walk.
Poses are right if they are so relative to the frames of the map around them, as errors of the map
are not those of locating. Located in it are single frames of another walk through the same rooms,
moved and turned by 10 cm and 5 degrees more ("near" the path of the map) or 40 cm and 20 degrees
("far"), clips of ten frames of that walk, and both in a building of the same plan with other
materials and furniture, in which every pose is wrong. Printed: the share within 5 cm, that which is
accepted, wrong ones among these (beyond 5 cm, or in the other building), the median error of those
accepted, and CPU time per frame. The camera has noise only, so errors in mm are those of the map,
not of a real camera.

    python benchmarks/locate.py [--rooms 12] [--frames 2400] [--queries 100] [--clips 10] [--seed 1]
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import hours
import tofuse
from tofuse.apps.jobs import locating
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.progress import Silent
from tofuse.lab.world.scene import Scene

NEAR_M = 0.05
# Nothing is nearer to the camera: it isn't in a wall.
MIN_DEPTH_M = 0.3
# Rows: name, seed of the building beyond that of the map, rms motion away from the walk, m and rad.
ROWS = (
    ("near", 0, 0.1, np.radians(5)),
    ("far", 0, 0.4, np.radians(20)),
    ("another building", 99, 0.1, np.radians(5)),
)
CLIP = 10
AROUND = 15  # frames of the map


def images(scene: Scene, poses: Float64, seed: int) -> list[RangeFrame]:
    """Images at poses (N, 4, 4)."""
    columns, rows, focal = hours.COLUMNS, hours.ROWS, hours.FOCAL
    camera = Pinhole(columns, rows, focal, focal, columns / 2 - 0.5, rows / 2 - 0.5)
    return [
        hours.image_of(scene, camera, T, k, np.random.default_rng([seed, k]))
        for k, T in enumerate(poses)
    ]


def drawn(
    rng: np.random.Generator, walk: Float64, scene: Scene, count: int, sigma: Float64, seed: int
) -> tuple[Float64, list[RangeFrame]]:
    """Return poses (count, 4, 4) about the walk, not within or at a wall, and their images."""
    poses: list[Float64] = []
    frames: list[RangeFrame] = []
    while len(frames) < count:
        T = walk[rng.integers(len(walk))] @ se3.exp(rng.normal(0, 1, 6) * sigma)
        (frame,) = images(scene, T[None], seed + len(frames))
        seen = frame.depth[frame.depth > 0]
        if len(seen) > 0.5 * frame.depth.size and np.quantile(seen, 0.1) > MIN_DEPTH_M:
            poses.append(T)
            frames.append(frame)
    return np.stack(poses), frames


def made_map(rooms: int, frames: int, seed: int) -> Path:
    """Return the result of a run on one walk, made once."""
    recording = hours.record(rooms, frames, frames, seed)
    folder = recording.with_name(f"{recording.name}-map")
    if not (folder / "run.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        tofuse.reconstruct(tofuse.open(recording)).save(folder)
    return folder


def in_map(poses: Float64, trajectory: Float64, walk: Float64) -> Float64:
    """True poses (M, 4, 4) in a map, as they are relative to its frames around them.

    Of these `trajectory` (N, 4, 4) are the poses in the map, and `walk` the true ones. Single
    frames of a map may have slid: of the poses that the nearest ones say, the most central counts.
    """
    posed = np.isfinite(trajectory).all((1, 2))
    trajectory, walk = trajectory[posed], walk[posed]
    result = []
    for T in poses:
        shift, turn = se3.lengths(se3.inverse(walk) @ T).T
        near = np.argsort(shift + turn)[:AROUND]
        said = trajectory[near] @ se3.inverse(walk[near]) @ T
        apart = np.linalg.norm(said[:, None, :3, 3] - said[None, :, :3, 3], axis=2)
        result.append(said[int(np.argmin(apart.sum(1)))])
    return np.stack(result)


def scored(
    name: str,
    located: Sequence[tuple[locating.LocatedFrame, Float64]],
    seconds: float,
    *,
    known: bool,
) -> str:
    """Return a row of the table; `known` poses can be right."""
    errors, accepted = [], []
    for frame, T in located:
        if frame.location is None:
            errors.append(np.inf)
        else:
            errors.append(
                float(np.linalg.norm((se3.inverse(T) @ frame.location.T_map_camera)[:3, 3]))
            )
        accepted.append(frame.accepted)
    near = np.array(errors) < NEAR_M if known else np.zeros(len(errors), bool)
    chosen = np.array(errors)[accepted]
    median = 1e3 * float(np.median(chosen)) if len(chosen) else np.nan
    count = len(located)
    return (
        f"{name:<24}{count:7d}{near.mean():12.0%}{np.mean(accepted):10.0%}"
        f"{int((np.array(accepted) & ~near).sum()):7d}{median:11.1f}{1e3 * seconds / count:10.0f}"
    )


def main() -> None:
    """Make the map, locate, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--frames", type=int, default=2400)
    parser.add_argument("--queries", type=int, default=100)
    parser.add_argument("--clips", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="of the building and the walks")
    options = parser.parse_args()
    rng = np.random.default_rng(5 + options.seed)
    folder = made_map(options.rooms, options.frames, options.seed)
    mapped = tofuse.load(folder).trajectory, hours.walk(options.rooms, options.frames, options.seed)
    start = time.process_time()
    index = locating.ResultMap.read(folder, None, Silent())
    print(f"index of the map: {time.process_time() - start:.1f} CPU s")
    walk = hours.walk(options.rooms, options.frames, options.seed + 7)
    print(
        f"{'':<24}{'frames':>7}{'within 5 cm':>12}{'accepted':>10}{'wrong':>7}{'median mm':>11}"
        f"{'CPU ms':>10}"
    )
    for name, seed, moved_m, turned in ROWS:
        scene = hours.building(options.rooms, options.seed + seed)
        sigma = np.repeat([moved_m, turned], 3) / 3**0.5
        poses, frames = drawn(rng, walk, scene, options.queries, sigma, 100 * seed + 1)
        index.locate_frame(frames[0])  # compiles
        start = time.process_time()
        located = [index.locate_frame(frame) for frame in frames]
        seconds = time.process_time() - start
        true = in_map(poses, *mapped)
        known = seed == 0
        print(scored(name, list(zip(located, true, strict=True)), seconds, known=known), flush=True)
    for name, seed in (("same building", 0), ("another building", 99)):
        scene, seconds = hours.building(options.rooms, options.seed + seed), 0.0
        pairs: list[tuple[locating.LocatedFrame, Float64]] = []
        for first in rng.choice(len(walk) - CLIP, options.clips):
            poses = walk[first : first + CLIP]
            frames = images(scene, poses, int(first))
            clip = Recording.of(ArraySource(frames), "clip", "arrays")
            start = time.process_time()
            located = index.locate_clip(clip, Silent())
            seconds += time.process_time() - start
            pairs += zip(located, in_map(poses, *mapped), strict=True)
        print(scored(f"clips, {name}", pairs, seconds, known=seed == 0), flush=True)


if __name__ == "__main__":
    main()
