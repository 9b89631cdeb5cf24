"""Global registration of two bare clouds: success of `tofuse.register`, and its calibration.

`table` prints, for each kind of pair, how many poses are right (within 0.1 m, or 5 % of the extent
if that is less, at the centre of the source, and 4 degrees), how many of those are accepted, and
how many are accepted and wrong; also for Open3D's RANSAC over FPFH with point-to-plane ICP, and for
KISS-Matcher, if installed, with voxels of 1/100 of the target's extent; then how many poses of each
place are right by the probability that they are stated with. Clouds have at most 20,000
points. "moved" clouds were transformed into another frame, so that their viewpoint is unknown; in
"sparse" pairs the source has a tenth of the target's points. `fit` fits the logistic models of
`tofuse.engine.search.pose_probability` to simulated pairs. `viewpoints` counts the clouds whose
origin is taken for the viewpoint.

    python benchmarks/cloud_pairs.py table [--data ../shared/data] [--kinds scans]
    python benchmarks/cloud_pairs.py fit
    python benchmarks/cloud_pairs.py viewpoints

Simulated scenes are made once and kept in benchmarks/out/recordings/pairs.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

from tofuse.engine.arrays import Float32, Float64

sys.path.insert(0, str(Path(__file__).resolve().parent))

import pairs
import tofuse
from peers import kiss_global, o3d_global
from sequences import DATA
from tofuse.engine.alignment.base import Registration
from tofuse.engine.clouds.cloud_pair import follow_clouds, register_clouds
from tofuse.engine.clouds.viewpoint import viewpoint_of
from tofuse.engine.compute import one_blas_thread
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import CloudFrame, Frame
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.icp import averaged
from tofuse.engine.search.pose_probability import PoseEvidence
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.world import scene as scenes

POINTS = 20_000
RIGHT_M, RIGHT_FRACTION, RIGHT_DEG = 0.1, 0.05, 4.0
# Clips: noise and largest range, drift from frame to frame, edge of the voxels, and the fraction of
# pairs that are moved to another frame.
_NOISE_M, _RANGE_M, _THINNED_M, _MOVED = 0.003, 5.0, 0.025, 0.3
_DRIFT = np.array([0.002] * 3 + [0.001] * 3)
# A rotating object stands in front of a static background.
OBJECT_M = 1.6
# Stated probabilities of which the table counts the right poses.
_BINS = (0.0, 0.3, 0.7, 0.9, 1.0)


@dataclass(frozen=True, eq=False)
class Pair:
    """Points (n, 3) of two views in m, and the true T_target_source; None without overlap."""

    source: Float64
    target: Float64
    true: Float64 | None

    @property
    def allowed_m(self) -> float:
        """Largest error of a right pose, m."""
        return min(RIGHT_M, RIGHT_FRACTION * self.extent)

    @property
    def extent(self) -> float:
        """Diagonal of the central part of the target, m."""
        low, high = np.percentile(self.target, [2, 98], axis=0)
        return float(np.linalg.norm(high - low))

    def error(self, T: Float64) -> tuple[float, float]:
        """Error at the centre of the source in m, and of the rotation in degrees."""
        if self.true is None:
            return np.inf, np.inf
        centre = np.median(self.source, 0)[None]
        gap = se3.transform(T, centre) - se3.transform(self.true, centre)
        turned = se3.angle(se3.inverse(self.true) @ T)
        return float(np.linalg.norm(gap)), float(np.degrees(turned))

    def is_right(self, T: Float64) -> bool:
        metres, degrees = self.error(T)
        return metres < self.allowed_m and degrees < RIGHT_DEG


Maker = Callable[[Path, int, np.random.Generator], Iterator[Pair]]


@dataclass(frozen=True)
class Kind:
    """Pairs of one kind; kinds of one family show the same place.

    The probability model is `fitted` on some kinds; the table shows those with `shown`.
    """

    name: str
    title: str
    make: Maker = field(repr=False)
    family: str
    fitted: bool = False
    shown: bool = True


def thinned(points: Float32, rng: np.random.Generator, max_points: int = POINTS) -> Float64:
    """Random subset of at most `max_points` points."""
    chosen = np.sort(rng.permutation(len(points))[:max_points])
    return points[chosen].astype(np.float64)


def frames(
    name: str, apart: tuple[int, ...], *, moved: bool = False, sparse: bool = False
) -> Maker:
    """Pairs of frames of a camera, from a scene of `pairs.py`."""

    def make(data: Path, max_pairs: int, rng: np.random.Generator) -> Iterator[Pair]:
        recording = pairs.opened(name, data)
        T = recording.reference
        assert T is not None
        for step in apart:
            for i, j in pairs.chosen(len(recording), step, max_pairs):
                if not np.isfinite(T[[i, j]]).all():
                    continue
                source, target = (_object(recording[k], name).points for k in (j, i))
                if min(len(source), len(target)) < 100:
                    continue
                source = thinned(source, rng, POINTS // 10 if sparse else POINTS)
                pair = Pair(source, thinned(target, rng), se3.inverse(T[i]) @ T[j])
                yield _elsewhere(pair, rng) if moved else pair

    return make


def _object(frame: Frame, name: str) -> Frame:
    if name not in ("torso", "box"):
        return frame
    near = np.linalg.norm(frame.points, axis=1) < OBJECT_M
    return CloudFrame(frame.index, frame.timestamp, frame.points[near])


def _elsewhere(pair: Pair, rng: np.random.Generator) -> Pair:
    """The same pair in other frames, with arbitrary rotations."""
    assert pair.true is not None
    A, B = (_any_motion(rng) for _ in range(2))
    source, target = se3.transform(A, pair.source), se3.transform(B, pair.target)
    return Pair(source, target, B @ pair.true @ se3.inverse(A))


def _any_motion(rng: np.random.Generator) -> Float64:
    axis = rng.standard_normal(3)
    axis *= rng.uniform(0, np.pi) / np.linalg.norm(axis)
    return np.asarray(se3.exp(np.r_[rng.uniform(-3, 3, 3), axis]))


def scans(name: str, *, moved: bool = False, points: int = 200_000, seed: int = 0) -> Maker:
    """Spherical scans with random heading along a path: pairs one and two scans apart."""

    def make(_data: Path, max_pairs: int, rng: np.random.Generator) -> Iterator[Pair]:
        taken = list(scanned(name, max_pairs + 1, points, seed))
        for apart in (1, 2):
            for (T_a, a), (T_b, b) in zip(taken[:-apart], taken[apart:], strict=True):
                pair = Pair(b.astype(float), a.astype(float), se3.inverse(T_a) @ T_b)
                yield _elsewhere(pair, rng) if moved else pair

    return make


def scanned(name: str, max_scans: int, points: int, seed: int) -> Iterator[tuple[Float64, Float32]]:
    """Poses (4, 4) in the room and points of a scanner with a grid of equal angles, z up."""
    built, sequence = scenes.build(name, seed=seed)
    rng = np.random.default_rng([seed, 5])
    rows = int(np.sqrt(points / 2))
    up = np.linspace(-0.39 * np.pi, 0.5 * np.pi, rows)
    around = np.linspace(-np.pi, np.pi, 2 * rows, endpoint=False)
    elevation, azimuth = np.meshgrid(up, around, indexing="ij")
    level = np.cos(elevation)
    rays = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], -1
    ).reshape(-1, 3)
    last, count = np.full(3, np.inf), 0
    for frame in range(0, 1140, 3):
        at = sequence.T_room_camera(frame / sequence.frame_rate_hz)[:3, 3]
        if np.linalg.norm(at - last) < 2.0:
            continue
        last, count = at, count + 1
        heading = rng.uniform(-np.pi, np.pi)
        T = np.asarray(se3.exp(np.array([0, 0, 0, 0, 0, heading])))
        T[:3, 3] = at
        hits = built.cast(at, rays @ T[:3, :3].T)
        seen = np.isfinite(hits.distance)
        distance = hits.distance[seen] + 0.003 * rng.standard_normal(int(seen.sum()))
        yield T, (rays[seen] * distance[:, None]).astype(np.float32)
        if count == max_scans:
            return


def clips(name: str, *, seed: int, fused: bool) -> Maker:
    """Clips of a walk through a scene, fused to one cloud, or their first frames; some are moved.

    The pairs overlap by any amount: a third of them by less than 30 %, a third not at all, as poses
    of different places of one scene are most often confused. A fused clip of 3 s drifts, and is
    thinned to 25 mm, as the fragments that a reconstruction is made from.
    """

    def make(_data: Path, max_pairs: int, rng: np.random.Generator) -> Iterator[Pair]:
        built, sequence = scenes.build(name, seed=seed)
        last = max(sequence.frames / sequence.frame_rate_hz - 3.2, 0.1)
        taken = []
        for start in np.linspace(0, last, 18):
            times = start + (np.linspace(0, 3, 12) if fused else np.zeros(1))
            taken.append((sequence.T_room_camera(start), _clip(built, sequence, times, rng)))
        pairs_of = [
            Pair(b, a, se3.inverse(T_a) @ T_b)
            for k, (T_a, a) in enumerate(taken)
            for T_b, b in taken[k + 1 :]
        ]
        overlaps = np.array([_overlap(pair) for pair in pairs_of])
        for low, high, share in ((0.08, 0.3, 2), (0.3, 0.7, 4), (0.7, 1.01, 4), (0.0, 0.01, 2)):
            fitting = np.flatnonzero((overlaps >= low) & (overlaps < high))
            for k in rng.permutation(fitting)[: -(-2 * max_pairs // share)]:
                pair = pairs_of[k]
                moved = _elsewhere(pair, rng) if rng.random() < _MOVED else pair
                yield Pair(moved.source, moved.target, moved.true if low else None)

    return make


def _clip(
    built: scenes.Scene, sequence: scenes.Sequence, times: Float64, rng: np.random.Generator
) -> Float64:
    """Points (n, 3) of some instants of a sequence in the frame of the first."""
    size = (160, 120) if len(times) == 1 else (96, 72)
    u, v = np.meshgrid(*(np.linspace(-0.5, 0.5, k) * k / size[0] for k in size))
    rays = np.stack([1.1 * u, 1.1 * v, np.ones_like(u)], -1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    T_camera_room, drift = se3.inverse(sequence.T_room_camera(times[0])), np.eye(4)
    points = []
    for t in times:
        T = sequence.T_room_camera(t)
        distance = built.cast(T[:3, 3], rays @ T[:3, :3].T).distance
        seen = distance < _RANGE_M  # inf where nothing is hit
        noise = _NOISE_M * (1 + 0.3 * distance[seen] ** 2) * rng.standard_normal(int(seen.sum()))
        drift = drift @ se3.exp(_DRIFT * rng.standard_normal(6))
        hit = rays[seen] * (distance[seen] + noise)[:, None]
        points.append(se3.transform(drift @ T_camera_room @ T, hit))
    joined = np.concatenate(points)
    if len(times) == 1:
        return joined
    return averaged(CloudFrame.of(joined), _THINNED_M).points.astype(np.float64)


def _overlap(pair: Pair) -> float:
    """Smaller one of the fractions of both clouds that lie near the other."""
    assert pair.true is not None
    T = pair.true
    shares = []
    for a, b, motion in ((pair.source, pair.target, T), (pair.target, pair.source, se3.inverse(T))):
        nearest, _ = KdTree(b).nearest(se3.transform(motion, a[::7]), 0.06)
        shares.append(float(np.mean(nearest >= 0)))
    return min(shares)


def _lidar_pair(data: Path, _max_pairs: int, _rng: np.random.Generator) -> Iterator[Pair]:
    folder = data / "lidar_pair_gt"
    if not folder.is_dir():
        raise FileNotFoundError(folder)
    source, target = (open_recording(folder / f"{name}.ply")[0] for name in ("source", "target"))
    true = np.loadtxt(folder / "T_target_source.txt").reshape(4, 4)
    yield Pair(source.points.astype(float), target.points.astype(float), true)


def _dragon(data: Path, max_pairs: int, _rng: np.random.Generator) -> Iterator[Pair]:
    """Range scans of a turning dragon of 0.2 m, 24 to 96 degrees apart."""
    folder = data / "stanford_dragon"
    if not folder.is_dir():
        raise FileNotFoundError(folder)
    scans, poses = np.load(folder / "scans.npz"), {}
    for line in (folder / "dragonStandRight.conf").read_text().splitlines():
        kind, *words = line.split() or [""]
        if kind == "bmesh":
            T = np.eye(4)
            T[:3, :3] = Rotation.from_quat([float(w) for w in words[4:8]]).as_matrix().T
            T[:3, 3] = [float(w) for w in words[1:4]]
            poses[int(words[0].removesuffix(".ply").split("_")[-1])] = T
    found = {int(name.split("_")[-1]): scans[name].astype(float) for name in scans.files}
    angles = sorted(poses)
    for apart in (1, 2, 3, 4):
        for k in np.linspace(0, len(angles) - 1, max_pairs).astype(int):
            i, j = angles[k], angles[(k + apart) % len(angles)]
            yield Pair(found[j], found[i], se3.inverse(poses[i]) @ poses[j])


def fragments(split: str) -> Maker:
    """Fragments of the 3DMatch benchmark, the same number of pairs of each scene."""

    def make(data: Path, max_pairs: int, rng: np.random.Generator) -> Iterator[Pair]:
        folders = sorted((data / "pairs_3dmatch").glob("*/fragments.npz"))
        if not folders:
            raise FileNotFoundError(data / "pairs_3dmatch")
        for file in folders:
            stored = np.load(file)
            log = (file.parent / f"{split}.gt.log").read_text()
            numbers = np.array(log.split(), float).reshape(-1, 19)
            apart = numbers[:, 1] - numbers[:, 0] > (split == "3DMatch")
            for i, j, _, *T in rng.permutation(numbers[apart])[: 3 * max_pairs]:
                target, source = (
                    stored[f"points_{k:.0f}"] * 0.00025 + stored[f"offset_{k:.0f}"] for k in (i, j)
                )
                yield Pair(source, target, np.reshape(T, (4, 4)))

    return make


_FRAMES = (
    ("room", "Furnished room, SR4000", (1, 2, 3), "room", False),
    ("empty-room", "Empty room, SR4000", (1, 3), "room", False),
    ("flat", "Flat of four rooms, SR4000", (1, 2, 3), "flat", False),
    ("flat-alike", "Flat with similar rooms, SR4000", (1, 2), "flat", False),
    ("torso", "Torso alone, SR4000", (1, 2, 4), "torso", False),
    ("rail", "Rail, pico flexx", (1, 2), "rail", False),
    ("hall", "Hall, ifm O3R", (1, 2), "hall", False),
    ("box", "Box alone, SR4000", (1, 2, 4), "box", False),
    ("kitchen", "7-Scenes kitchen, Kinect v1", (10, 30, 60), "kitchen", False),
)
KINDS = {
    kind.name: kind
    for kind in (
        *(
            Kind(name, title, frames(name, apart), family, fitted)
            for name, title, apart, family, fitted in _FRAMES
        ),
        *(
            Kind(
                f"{name}-moved", f"{title}, moved", frames(name, apart, moved=True), family, fitted
            )
            for name, title, apart, family, fitted in _FRAMES
        ),
        *(
            Kind(
                f"{name}-sparse",
                f"{title}, sparse",
                frames(name, apart, sparse=True),
                family,
                False,
            )
            for name, title, apart, family, _ in _FRAMES
            if name in ("flat", "torso", "kitchen")
        ),
        Kind("scans", "Scans of the flat", scans("flat"), "flat"),
        Kind("scans-moved", "Scans of the flat, moved", scans("flat", moved=True), "flat"),
        Kind("scans-2", "Scans of another flat", scans("flat", seed=3), "flat", False),
        Kind("lidar", "LiDAR outdoors", _lidar_pair, "lidar", False),
        Kind("dragon", "Laser scans of a dragon", _dragon, "dragon"),
        Kind("fragments", "Fragments of 3DMatch", fragments("3DMatch"), "fragments"),
        Kind("fragments-low", "Fragments of 3DLoMatch", fragments("3DLoMatch"), "fragments"),
        # Scenes that are not in the table.
        *(
            Kind(
                f"{'clips' if fused else 'views'}-of-{name}-{seed}",
                f"{'Clips' if fused else 'Views'} of {name} {seed}",
                clips(name, seed=seed, fused=fused),
                name.removesuffix("-alike") + ("" if fused else "-views"),
                fitted=True,
                shown=False,
            )
            for name, seed, fused in (
                ("flat", 1, True),
                ("flat", 2, True),
                ("flat-alike", 2, True),
                ("room", 1, True),
                ("rail", 1, True),
                ("flat", 4, False),
                ("hall", 3, False),
                ("room", 3, False),
            )
        ),
        *(
            Kind(
                f"scans-of-{seed}{name}",
                f"Scans of flat {seed}{name}",
                scans("flat", moved=bool(name), seed=seed, points=POINTS),
                "scans",
                fitted=True,
                shown=False,
            )
            for seed in (1, 2)
            for name in ("", "-moved")
        ),
    )
}


def correctness(pair: Pair, found: Registration | Float64) -> tuple[bool, bool, float]:
    """Whether a pose is right, whether it is accepted, and its stated probability."""
    if isinstance(found, Registration):
        T = found.T_target_source
        return pair.is_right(T), bool(found.believed), found.probability or 0.0
    return pair.is_right(found), False, 0.0


def timed(method: pairs.Method, pair: Pair) -> tuple[bool, bool, float, float]:
    """As `correctness`, and seconds; a failed registration counts as wrong."""
    views = CloudFrame.of(pair.source, index=1), CloudFrame.of(pair.target)
    start = time.perf_counter()
    try:
        found = method(*views)
    except RegistrationError:
        return False, False, 0.0, time.perf_counter() - start
    return *correctness(pair, found), time.perf_counter() - start


def print_table(names: list[str], data: Path, max_pairs: int) -> None:
    """Print a row for each kind, and the ROC area of the probability over all of them."""
    print(
        "| Clouds | right | of these accepted | accepted and wrong | s a pair"
        " | Open3D | s | KISS-Matcher | s |\n|---|---|---|---|---|---|---|---|---|"
    )
    p, right, by_family = [], [], {}  # type: ignore[var-annotated]
    for name in names:
        ours, theirs = [], ([], [])  # type: ignore[var-annotated]
        try:
            made = list(KINDS[name].make(data, max_pairs, np.random.default_rng([1, 5])))
        except FileNotFoundError:
            print(f"| {name}: no data |")
            continue
        for pair in made:
            if not p:
                timed(tofuse.register, pair)  # compiles
            ours.append(timed(tofuse.register, pair))
            right.append(ours[-1][0])
            p.append(ours[-1][2])
            voxel = pair.extent / 100
            for peer, rows in zip((o3d_global, kiss_global), theirs, strict=True):
                method = peer.method(voxel)
                if method is not None:
                    rows.append(timed(method, pair))
        by_family.setdefault(KINDS[name].family, []).extend(ours)
        print(_row(KINDS[name].title, ours, theirs), flush=True)
    wrong = sum(x >= pairs.ACCEPTED and not r for x, r in zip(p, right, strict=True))
    print(
        f"\n{len(p)} pairs, accepted {sum(x >= pairs.ACCEPTED for x in p)}, of these wrong {wrong}"
    )
    print(f"area under the ROC curve {pairs.roc_area(np.array(p), np.array(right)):.3f}")
    pairs.print_calibration(np.array(p), np.array(right))
    _print_reliability(by_family)
    _print_decoys(names, data, max_pairs)


def _print_reliability(by_family: dict[str, list[tuple[bool, bool, float, float]]]) -> None:
    """Print how many poses are right, for each place and range of the stated probability."""
    bins = [f"{low:g} to {high:g}" for low, high in itertools.pairwise(_BINS)]
    print(f"\n| probability | {' | '.join(bins)} |\n|{'---|' * (len(bins) + 1)}")
    for family, rows in by_family.items():
        which = np.searchsorted(_BINS, [row[2] for row in rows], side="right") - 1
        which = np.minimum(which, len(bins) - 1)
        cells = []
        for k in range(len(bins)):
            right = [row[0] for row, bin_ in zip(rows, which, strict=True) if bin_ == k]
            cells.append(f"{sum(right)} of {len(right)}")
        print(f"| {family} | {' | '.join(cells)} |")


def _row(title: str, ours: list, theirs: tuple[list, list]) -> str:  # type: ignore[type-arg]
    right = sum(o[0] for o in ours)
    cells = [title, f"{right} of {len(ours)}", sum(o[0] and o[1] for o in ours)]
    cells += [sum(o[1] and not o[0] for o in ours), f"{np.median([o[3] for o in ours]):.2f}"]
    for rows in theirs:
        cells += (
            [sum(o[0] for o in rows), f"{np.median([o[3] for o in rows]):.2f}"]
            if rows
            else [
                "",
                "",
            ]
        )
    return f"| {' | '.join(map(str, cells))} |"


def decoys(
    names: list[str], data: Path, max_pairs: int, rng: np.random.Generator
) -> Iterator[tuple[Pair, str]]:
    """Pairs of views of different places, some moved, with the kind of the source."""
    made: dict[str, list[Pair]] = {}
    for name in names:
        try:
            made[name] = list(KINDS[name].make(data, max_pairs, rng))
        except FileNotFoundError:
            continue
    for name, mine in made.items():
        others = [n for n in made if KINDS[n].family != KINDS[name].family]
        for _ in range(max_pairs if others else 0):
            other = made[others[int(rng.integers(len(others)))]]
            a, b = mine[int(rng.integers(len(mine)))], other[int(rng.integers(len(other)))]
            yield Pair(a.source, b.target, None), name


def _print_decoys(names: list[str], data: Path, max_pairs: int) -> None:
    found = [
        timed(tofuse.register, pair)
        for pair, _ in decoys(names, data, max_pairs, np.random.default_rng([1, 6]))
    ]
    if found:
        accepted = sum(f[1] for f in found)
        print(f"\nof {len(found)} pairs of different places {accepted} accepted", end=", ")
        print(f"highest probability {max(f[2] for f in found):.2f}")


def print_fit(data: Path, max_pairs: int) -> None:
    """Print coefficients of both models, and test those in use on kinds not used in the fit."""
    fitted = [kind.name for kind in KINDS.values() if kind.fitted]
    others = [kind.name for kind in KINDS.values() if kind.shown and not kind.fitted]
    titles = (
        "Searched: constant, sqrt of lead in surfaces, no free space, contradiction",
        "Followed: constant, support, sqrt of contradiction",
    )
    for title, rows in zip(titles, samples(fitted, data, max_pairs), strict=True):
        pairs.print_fit(title, pairs.stacked([row[:3] for row in rows]))
    for title, held_out in zip(titles, samples(others, data, max_pairs), strict=True):
        p = np.array([row[3] for row in held_out])
        right = np.array([row[1] for row in held_out], bool)
        accepted = p >= pairs.ACCEPTED
        print(f"\n{title.partition(':')[0]}, coefficients in use, on {len(p)} poses of", end=" ")
        print(f"{', '.join(others)}:")
        print(f"area under the ROC curve {pairs.roc_area(p, right):.3f}, accepted", end=" ")
        print(f"{accepted.sum()}, of these wrong {(accepted & ~right).sum()}")


@contextmanager
def decisions() -> Iterator[list[tuple[PoseEvidence, Registration]]]:
    """Record the evidence of each pose that is decided on."""
    made: list[tuple[PoseEvidence, Registration]] = []
    decide = PoseEvidence.applied

    def recorded(evidence: PoseEvidence, *given: Any) -> Registration:
        made.append((evidence, decide(evidence, *given)))
        return made[-1][1]

    with mock.patch.object(PoseEvidence, "applied", recorded):
        yield made


# Regressors, whether the pose is right, index of the family, and the probability in use.
Row = tuple[Float64, bool, int, float]


def samples(names: list[str], data: Path, max_pairs: int) -> tuple[list[Row], list[Row]]:
    """Poses from the global search, and from initial guesses without degenerate directions.

    Some of the pairs are of different places.
    """
    families = sorted({kind.family for kind in KINDS.values()})
    searched: list[Row] = []
    followed: list[Row] = []
    rng = np.random.default_rng([1, 7])
    todo = []
    for name in names:
        try:
            todo += [(pair, name) for pair in KINDS[name].make(data, max_pairs, rng)]
        except FileNotFoundError:
            print(f"{name}: no data")
    todo += list(decoys(names, data, max_pairs, rng))
    for pair, name in todo:
        views = CloudFrame.of(pair.source, index=1), CloudFrame.of(pair.target)
        start = np.eye(4) if pair.true is None else pair.true
        family = families.index(KINDS[name].family)
        for guess in (None, *(start @ _off_by(m, d, rng) for m, d in pairs.GUESSES)):
            rng_pair = np.random.default_rng(0)
            try:
                with decisions() as made, one_blas_thread():
                    if guess is None:
                        result = register_clouds(*views, None, rng_pair, always_search=True)
                    else:
                        result = follow_clouds(*views, guess, rng_pair)
            except RegistrationError:
                continue
            T = result.T_target_source
            evidence = next(e for e, found in reversed(made) if found.T_target_source is T)
            right, p = pair.is_right(T), evidence.probability
            if evidence.margin is not None:
                searched.append((evidence.search_regressors, right, family, p))
            elif guess is not None and not evidence.degenerate:
                followed.append((evidence.local_regressors, right, family, p))
    return searched, followed


def print_viewpoints(names: list[str], data: Path, max_pairs: int) -> None:
    """Print for how many clouds the origin is taken for the viewpoint, rightly and wrongly."""
    counts = {False: [0, 0], True: [0, 0]}
    for name in names:
        try:
            made = list(KINDS[name].make(data, max_pairs, np.random.default_rng([1, 5])))
        except FileNotFoundError:
            continue
        count = counts[name.endswith("-moved")]
        for points in (points for pair in made for points in (pair.source, pair.target)):
            count[0] += viewpoint_of(CloudFrame.of(points)) is not None
            count[1] += 1
    for moved, (found, total) in counts.items():
        where = "another frame" if moved else "the camera's frame"
        print(f"in {where} the origin is taken for the viewpoint of {found} of {total} clouds")


def _off_by(metres: float, degrees: float, rng: np.random.Generator) -> Float64:
    way = rng.standard_normal((2, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return np.asarray(se3.exp(np.r_[metres * way[0], np.radians(degrees) * way[1]]))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["table", "fit", "viewpoints"])
    parser.add_argument("--data", type=Path, default=DATA)
    shown = [kind.name for kind in KINDS.values() if kind.shown]
    parser.add_argument("--kinds", nargs="*", choices=list(KINDS), default=shown)
    parser.add_argument("--pairs", type=int, default=8, help="pairs for each step")
    given = parser.parse_args(arguments)
    if given.what == "table":
        print_table(given.kinds, given.data, given.pairs)
    elif given.what == "viewpoints":
        print_viewpoints(given.kinds, given.data, given.pairs)
    else:
        print_fit(given.data, given.pairs)


if __name__ == "__main__":
    main()
