"""Pairs of bare clouds with a known motion, simulated and real, by kind.

The pairs of one family show the same kind of place by the same kind of sensor. Clouds have at most
20,000 points; some were moved to another frame, so that their viewpoint is unknown; in "sparse"
pairs the source has a tenth of the target's points. Some pairs have no overlap, or no
pose that can be known; whatever is found is wrong there. Simulated scenes are made once and kept in
benchmarks/out/recordings/pairs.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import made_clouds
import pairs
from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.frames.frames import CloudFrame, Frame
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.icp import averaged
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.world import scene as scenes

POINTS = 20_000
RIGHT_M, RIGHT_FRACTION, RIGHT_DEG = 0.1, 0.05, 4.0
# Largest error of a right pose of 3DMatch.
BENCHMARK_M = 0.2
# Clips: noise and largest range, drift from frame to frame, edge of the voxels, and the fraction of
# pairs that are moved to another frame.
_NOISE_M, _RANGE_M, _THINNED_M, _MOVED = 0.003, 5.0, 0.025, 0.3
_DRIFT = np.array([0.002] * 3 + [0.001] * 3)
# A rotating object stands in front of a static background.
OBJECT_M = 1.6
# Accuracy of the motion between two poses of the laser on a car, each good to 0.2 m.
CAR_TRUTH_M = 0.28
# Pose of the car's scan 3 in the map of the others, from point-to-plane ICP with all their points
# (37 % of its points lie within 0.3 m of those; 18 % or less if it is moved by 3 m along the road,
# 7 % if across). Its own file has the pose in another map, of the same place.
_T_MAP_CAR_3 = se3.exp([30.598, 4.031, 0.055, -0.0016, -0.0118, 0.0095])


@dataclass(frozen=True, eq=False)
class Pair:
    """Points (n, 3) of two views in m, and the true T_target_source.

    That is None without overlap, or if the pose can't be known; it is good to `truth_m`. Pairs of a
    benchmark have its information matrix (6, 6), which decides which poses are right. Some families
    have several scenes.
    """

    source: Float64
    target: Float64
    true: Float64 | None
    truth_m: float = 0.0
    information: Float64 | None = None
    scene: str = ""

    @property
    def allowed_m(self) -> float:
        """Largest error of a right pose, m."""
        return min(RIGHT_M, RIGHT_FRACTION * self.extent) + self.truth_m

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

    def relative_error(self, T: Float64) -> float:
        """Error of a pose, relative to the largest one of a right pose."""
        if self.true is not None and self.information is not None:
            return _benchmark_error(self.true, T, self.information) / BENCHMARK_M
        metres, degrees = self.error(T)
        return max(metres / self.allowed_m, degrees / RIGHT_DEG)

    def is_right(self, T: Float64) -> bool:
        return self.relative_error(T) < 1

    def between_views(self, sparse: bool, rng: np.random.Generator) -> Pair:
        """The pair with fewer points: at most `POINTS`, a tenth of that of a sparse source."""
        source = thinned(self.source, rng, POINTS // 10 if sparse else POINTS)
        return replace(self, source=source, target=thinned(self.target, rng))


def _benchmark_error(true: Float64, T: Float64, information: Float64) -> float:
    """Root mean square error of the corresponding points, m, as 3DMatch approximates it."""
    gap = se3.inverse(true) @ T
    quaternion = Rotation.from_matrix(gap[:3, :3]).as_quat(canonical=True)
    e = np.r_[gap[:3, 3], quaternion[:3]]
    return float(np.sqrt(max(e @ information @ e, 0.0) / information[0, 0]))


Maker = Callable[[Path, int, np.random.Generator], Iterator[Pair]]


@dataclass(frozen=True)
class Kind:
    """Pairs of one kind; the probability model is `fitted` to some."""

    name: str
    family: str
    make: Maker = field(repr=False)
    fitted: bool = True


def thinned(
    points: Float32 | Float64, rng: np.random.Generator, max_points: int = POINTS
) -> Float64:
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
                pair = Pair(source, target, se3.inverse(T[i]) @ T[j]).between_views(sparse, rng)
                yield elsewhere(pair, rng) if moved else pair

    return make


def _object(frame: Frame, name: str) -> Frame:
    if name not in ("torso", "box"):
        return frame
    near = np.linalg.norm(frame.points, axis=1) < OBJECT_M
    return CloudFrame(frame.index, frame.timestamp, frame.points[near])


def elsewhere(pair: Pair, rng: np.random.Generator) -> Pair:
    """The same pair in other frames, with arbitrary rotations."""
    A, B = (any_motion(rng) for _ in range(2))
    source, target = se3.transform(A, pair.source), se3.transform(B, pair.target)
    true = None if pair.true is None else B @ pair.true @ se3.inverse(A)
    return replace(pair, source=source, target=target, true=true)


def any_motion(rng: np.random.Generator) -> Float64:
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
                yield elsewhere(pair, rng) if moved else pair

    return make


def scanner_rays(count: int) -> Float64:
    """About `count` unit rays (n, 3) of a scanner, z up, at equal angles."""
    rows = int(np.sqrt(count / 2))
    up = np.linspace(-0.39 * np.pi, 0.5 * np.pi, rows)
    around = np.linspace(-np.pi, np.pi, 2 * rows, endpoint=False)
    elevation, azimuth = np.meshgrid(up, around, indexing="ij")
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], -1)
    return np.asarray(rays.reshape(-1, 3), np.float64)


def scanned(name: str, max_scans: int, points: int, seed: int) -> Iterator[tuple[Float64, Float32]]:
    """Poses (4, 4) in the room and points of a scanner with a grid of equal angles, z up."""
    built, sequence = scenes.build(name, seed=seed)
    rng = np.random.default_rng([seed, 5])
    rays = scanner_rays(points)
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
                moved = elsewhere(pair, rng) if rng.random() < _MOVED else pair
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


def _folder(data: Path, name: str) -> Path:
    if not (data / name).is_dir():
        raise FileNotFoundError(data / name)
    return data / name


def _points(file: Path) -> Float64:
    return open_recording(file)[0].points.astype(float)


def _lasers(data: Path, max_pairs: int, rng: np.random.Generator) -> Iterator[Pair]:
    """Scans of lasers indoors, outdoors and on a car, and overlapping parts of single scans."""
    folder = _folder(data, "lidar_pair_gt")
    outdoors = [_points(folder / f"{name}.ply") for name in ("source", "target")]
    true = np.loadtxt(folder / "T_target_source.txt").reshape(4, 4)
    found = [Pair(outdoors[0], outdoors[1], true)]
    folder = _folder(data, "cases/laser_scans_car")
    car = [_points(folder / f"{k}.ply") for k in range(4)]
    poses = [*(np.loadtxt(folder / f"{k}.pose.txt") for k in range(3)), _T_MAP_CAR_3]
    for i, j in itertools.combinations(range(4), 2):
        found.append(Pair(car[j], car[i], se3.inverse(poses[i]) @ poses[j], CAR_TRUTH_M))
    found += [Pair(p.target, p.source, None if p.true is None else se3.inverse(p.true), p.truth_m)
              for p in found]  # fmt: skip
    folder = _folder(data, "cases/laser_pair")
    room = [_points(folder / f"cloud_{k}.ply") for k in range(2)]
    found += [Pair(room[0], outdoors[0], None), Pair(car[0], outdoors[1], None)]
    for cloud in (*room, *outdoors, *car[:2]):
        found += [_parts(cloud, rng) for _ in range(max(1, max_pairs // 4))]
    found += [_apart(cloud, rng) for cloud in (*room, *outdoors, *car) for _ in range(max_pairs)]
    for pair in found:
        few = pair.between_views(False, rng)
        yield elsewhere(few, rng) if rng.random() < _MOVED else few


def _parts(points: Float64, rng: np.random.Generator) -> Pair:
    """Two parts of a cloud without common points, each on one side of a plane and moved."""
    order = rng.permutation(len(points))
    parts = []
    for half in (order[::2], order[1::2]):
        way = rng.standard_normal(3) * [1, 1, 0.3]
        along = points[half] @ way
        parts.append(points[half][along < np.quantile(along, rng.uniform(0.55, 0.9))])
    return elsewhere(Pair(*parts, np.eye(4)), rng)


def _apart(points: Float64, rng: np.random.Generator) -> Pair:
    """Parts of a cloud on both sides of a plane: they have no common surface."""
    along = points @ (rng.standard_normal(3) * [1, 1, 0.3])
    far = along > np.quantile(along, rng.uniform(0.35, 0.65))
    return Pair(points[far], points[~far], None)


def dragon_scans(data: Path) -> list[tuple[Float64, Float64]]:
    """Return the poses (4, 4) and points of scans of a dragon that turns once, 24 degrees apart."""
    folder = _folder(data, "stanford_dragon")
    scans, poses = np.load(folder / "scans.npz"), {}
    for line in (folder / "dragonStandRight.conf").read_text().splitlines():
        kind, *words = line.split() or [""]
        if kind == "bmesh":
            T = np.eye(4)
            T[:3, :3] = Rotation.from_quat([float(w) for w in words[4:8]]).as_matrix().T
            T[:3, 3] = [float(w) for w in words[1:4]]
            poses[int(words[0].removesuffix(".ply").split("_")[-1])] = T
    found = {int(name.split("_")[-1]): scans[name].astype(float) for name in scans.files}
    return [(poses[angle], found[angle]) for angle in sorted(poses)]


def _dragon(data: Path, max_pairs: int, _rng: np.random.Generator) -> Iterator[Pair]:
    """Range scans of a turning dragon of 0.2 m, 24 to 96 degrees apart; some show its back."""
    scans = dragon_scans(data)
    for apart in (1, 2, 3, 4):
        for k in np.linspace(0, len(scans) - 1, max_pairs).astype(int):
            (T_i, target), (T_j, source) = scans[k], scans[(k + apart) % len(scans)]
            yield Pair(source, target, se3.inverse(T_i) @ T_j, scene=f"{24 * apart} degrees")
    for k in range(0, len(scans) // 2, 2):
        yield Pair(scans[k][1], scans[k + len(scans) // 2][1], None)


def _dragon_spoilt(data: Path, max_pairs: int, rng: np.random.Generator) -> Iterator[Pair]:
    """Scans of the dragon 24 and 48 degrees apart, with random points in and around their boxes."""
    pairs = list(_dragon(data, max_pairs, rng))[: 2 * max_pairs]
    for percent in (10, 20, 50):
        for pair in pairs:
            clouds = [_spoilt(points, percent / 100, rng) for points in (pair.source, pair.target)]
            yield Pair(*clouds, pair.true, scene=f"{percent} % random points")


def _spoilt(points: Float64, share: float, rng: np.random.Generator) -> Float64:
    """Points with random ones, as a share of them, in a box half as large again."""
    low, high = points.min(0), points.max(0)
    margin, count = 0.25 * (high - low), int(share * len(points))
    return np.vstack([points, rng.uniform(low - margin, high + margin, (count, 3))])


def fragments(split: str) -> Maker:
    """Fragments of the 3DMatch benchmark, the same number of pairs of each scene."""

    def make(data: Path, max_pairs: int, rng: np.random.Generator) -> Iterator[Pair]:
        for file in sorted(_folder(data, "pairs_3dmatch").glob("*/fragments.npz")):
            stored = np.load(file)
            rows = {
                suffix: np.array((file.parent / f"{split}.gt.{suffix}").read_text().split(), float)
                for suffix in ("log", "info")
            }
            poses, information = rows["log"].reshape(-1, 19), rows["info"].reshape(-1, 39)
            apart = poses[:, 1] - poses[:, 0] > (split == "3DMatch")
            for k in rng.permutation(np.flatnonzero(apart))[: 3 * max_pairs]:
                i, j, _, *T = poses[k]
                target, source = (
                    stored[f"points_{n:.0f}"] * 0.00025 + stored[f"offset_{n:.0f}"] for n in (i, j)
                )
                matrix = information[k, 3:].reshape(6, 6)
                true, scene = np.reshape(T, (4, 4)), file.parent.name
                yield Pair(source, target, true, information=matrix, scene=scene)

    return make


def _fragments_apart(data: Path, max_pairs: int, rng: np.random.Generator) -> Iterator[Pair]:
    """Fragments of 3DMatch without overlap, of one scene and of two."""
    files = sorted(_folder(data, "pairs_3dmatch").glob("*/fragments.npz"))
    for a, b in itertools.product(files, files):
        first, second = (np.load(file) for file in (a, b))
        counts = [sum(n.startswith("points_") for n in stored.files) for stored in (first, second)]
        overlaps = np.loadtxt(a.parent / "3DMatch.gt_overlap.log", delimiter=",")
        for _ in range(max_pairs if a != b else 2 * max_pairs):
            i, j = rng.integers(counts)
            while a == b and (i == j or _overlap_of(overlaps, i, j) > 0):
                i, j = rng.integers(counts)
            target, source = (
                stored[f"points_{k}"] * 0.00025 + stored[f"offset_{k}"]
                for stored, k in ((first, i), (second, j))
            )
            yield Pair(source, target, None)


def _overlap_of(overlaps: Float64, i: int, j: int) -> float:
    """The stated overlap of two fragments, from rows of both numbers and their overlap."""
    row = (overlaps[:, 0] == min(i, j)) & (overlaps[:, 1] == max(i, j))
    return float(overlaps[row, 2].max(initial=0.0))


def _boxes(_data: Path, max_pairs: int, rng: np.random.Generator) -> Iterator[Pair]:
    """Parts of random rooms of boxes, and of different ones."""
    for k in range(6 * max_pairs):
        pair, other = (_parts(_noisy(made_clouds.furnished(rng=rng), rng), rng) for _ in range(2))
        yield replace(pair, target=other.target, true=None) if k % 4 == 3 else pair


def _noisy(points: Float64, rng: np.random.Generator) -> Float64:
    return points + rng.normal(0, made_clouds.NOISE_M, points.shape)


def _symmetric(_data: Path, max_pairs: int, _rng: np.random.Generator) -> Iterator[Pair]:
    """Bodies that were turned by a symmetry: nobody knows by which."""
    for _, make in itertools.islice(made_clouds.symmetric_pairs(), 7 * max_pairs):
        pair = make(1)
        yield Pair(pair.source, pair.target, None)


_CLIPS = (("flat", 1), ("room", 1))
_VIEWS = (("room", 3), ("hall", 3))
_SCANS = ((1, True), (2, False))
KINDS = {
    kind.name: kind
    for kind in (
        *(
            Kind(f"clips-{name}-{seed}", "clips", clips(name, seed=seed, fused=True))
            for name, seed in _CLIPS
        ),
        *(
            Kind(f"views-{name}-{seed}", "views", clips(name, seed=seed, fused=False))
            for name, seed in _VIEWS
        ),
        *(
            Kind(
                f"scans-{seed}{'-moved' if moved else ''}",
                "scans",
                scans("flat", moved=moved, seed=seed, points=POINTS),
            )
            for seed, moved in _SCANS
        ),
        Kind("kitchen", "kitchen", frames("kitchen", (10, 30, 60))),
        Kind("torso", "objects", frames("torso", (1, 2, 4))),
        Kind("dragon", "dragon", _dragon),
        Kind("lasers", "lasers", _lasers),
        Kind("boxes", "random boxes", _boxes),
        Kind("symmetric", "symmetric bodies", _symmetric),
        Kind("3DMatch", "3DMatch", fragments("3DMatch"), fitted=False),
        Kind("3DLoMatch", "3DLoMatch", fragments("3DLoMatch"), fitted=False),
        Kind("dragon-spoilt", "dragon, random points", _dragon_spoilt, fitted=False),
        Kind("fragments-apart", "3DMatch, apart", _fragments_apart, fitted=False),
    )
}


def made(name: str, data: Path, max_pairs: int) -> list[Pair]:
    """The pairs of a kind, the same ones each time; none without its data."""
    try:
        return list(KINDS[name].make(data, max_pairs, np.random.default_rng([1, 5])))
    except FileNotFoundError as error:
        print(f"{name}: no data at {error}")
        return []
