"""Lengths between two points of a model: whether the stated intervals contain the true ones.

`simulated`: points of the surface in simulated recordings, by time-of-flight cameras with multipath
and by a phone with smooth depth and poses that drift; with the right focal length, and with wrong
ones; the scale of the depth is wrong by up to 1 %, as data sheets state. The true place of a point
is the mean of what the images that measured it saw at its pixels.

`recorded`: corners of tags on a table before an Azure Kinect, tapped in the depth images. Their
true places are triangulated from the colour images at the poses of a bundle adjustment of the tags.

    python benchmarks/lengths.py simulated [--only 3]
    python benchmarks/lengths.py recorded [--data FOLDER]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path

import cv2
import numpy as np

import unusual
from tofuse.apps.api.result import Result, reconstruct
from tofuse.apps.certainty import LengthErrors
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.depth_counts import depth_from_counts
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import POSES_BY, ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.phone import PhonePlan
from tofuse.lab.simulation.record import RecordingPlan, corrected
from tofuse.lab.world import scene as scenes

CAMERAS = {
    "o3r": unusual.pinhole("ifm-o3r", 80, 60, 60),
    "azure": unusual.pinhole("azure-nfov", 96, 80, 75),
    "sr4000": unusual.pinhole("sr4000", 88, 72, 44),
    "phone": unusual.pinhole("sr4000", 96, 72, 62),
}
# Points of a model, and pairs of them of each kind, which are at least so far apart.
VERTICES, PAIRS, MIN_LENGTH = 400, 400, 0.05
# Points count that at least so many images saw, without a larger jump of the range, as a fraction
# of it, within so many pixels: no one can tap on what is mixed with its background.
VIEWS, JUMP, EDGE = 3, 0.15, 2
# Recordings: case, camera, focal length and depth relative to the true ones, and seed. The errors
# of the depth are spread evenly.
RUNS = (
    ("room, short", "phone", 1.0, 0.9950, 0),
    ("room, turn", "o3r", 1.0, 1.0006, 0),
    ("attic, turn", "phone", 1.02, 0.9972, 0),
    ("books, pan", "azure", 1.0, 0.9961, 0),
    ("room, short", "sr4000", 1.02, 1.0061, 0),
    ("room, short", "azure", 0.99, 1.0083, 1),
    ("books, pan", "phone", 0.98, 1.0094, 1),
    ("attic, turn", "o3r", 0.98, 0.9917, 1),
    ("room, turn", "phone", 1.0, 0.9928, 0),
    ("room, turn", "azure", 1.02, 1.0072, 1),
    ("books, pan", "sr4000", 1.01, 1.0017, 1),
    ("room, short", "o3r", 1.01, 0.9939, 2),
    ("attic, turn", "azure", 1.0, 1.0039, 1),
    ("room, short", "phone", 1.02, 0.9983, 2),
    ("room, turn", "sr4000", 1.0, 1.0050, 2),
    ("flat, walk", "phone", 1.0, 0.9906, 0),
    ("flat, walk", "azure", 1.0, 1.0028, 0),
    ("attic, turn", "sr4000", 1.01, 0.9994, 2),
)
TITLES = "pairs | bounded | inside | error, mm | interval, mm | interval / error"
TAGS = cv2.aruco.DICT_6X6_50
# Pairs of points by the fraction of the images of one that saw the other as well, above the first.
KINDS = {"the same views": 0.8, "some of them": 0.0, "no common view": -1.0}


@dataclass(frozen=True)
class Case:
    """A scene and motion, and how many frames of it at which rate."""

    scene: unusual.Unusual
    frames: int
    rate_hz: float


def _unusual(name: str) -> unusual.Unusual:
    return unusual.UNUSUAL[name]


_room, _flat = _unusual("80 x 60 pixels"), _unusual("elsewhere in the flat")
CASES = {
    "room, turn": Case(_room, 64, 2.1),
    "room, short": Case(_room, 24, 6.0),
    "attic, turn": Case(_unusual("attic"), 64, 6.2),
    "flat, walk": Case(_flat, 48, 6.0),
    "books, pan": Case(_unusual("bookshelf"), 40, 4.0),
}


@dataclass(frozen=True, eq=False)
class Taken:
    """A recording with the stated camera, and the true points of its pixels.

    Attributes
    ----------
    points
        (H, W, 3) of each frame, in the world of the first camera; NaN without a surface.
    poses
        (N, 4, 4) true ones.
    """

    recording: Recording
    camera: Pinhole
    points: list[Float64]
    poses: Float64


def simulated(case: Case, camera: str, focal: float, scale: float, seed: int) -> Taken:
    """Simulate a case; stated focal length and depth are `focal` and `scale` times the true ones.

    A phone has smooth depth without amplitude, and own poses that drift.
    """
    model = replace(CAMERAS[camera], frame_rate_hz=case.rate_hz)
    effects = Effects.none() if camera == "phone" else Effects()
    sequence = scenes.Sequence(case.frames, 1, case.rate_hz, case.scene.path(seed))
    scene = case.scene.scene(seed)
    made = RecordingPlan(scene, sequence, model, effects, seed, np.arange(case.frames))
    true = made.model.camera
    stated = replace(true, fx=focal * true.fx, fy=focal * true.fy)
    factory = made.correction
    times = made.raw / case.rate_hz
    phone = PhonePlan(scene, sequence, times, seed=seed, depth=true, color_every=0)
    frames: list[RangeFrame] = []
    points: list[Float64] = []
    taken = phone.frames() if camera == "phone" else repeat(None, case.frames)
    for T, rendered, shot in zip(made.poses, made.frames(None), taken, strict=True):
        frame = rendered.frame
        if shot is not None:
            depth = depth_from_counts(shot.depth, 0.001)
            frame = RangeFrame(frame.index, frame.timestamp, true, depth)
        else:
            frame = corrected(frame, factory)
        z = replace(rendered.frame, depth=rendered.depth).z.astype(float)[..., None]
        exact = np.where(z > 0, np.concatenate([z * true.rays(), z], -1), np.nan)
        points.append(exact @ T[:3, :3].T + T[:3, 3])
        frames.append(replace(frame, camera=stated, depth=np.float32(scale) * frame.depth))
    metadata = {"frame_rate_hz": case.rate_hz, "sensor": f"lengths {camera}"}
    poses = made.poses
    if camera == "phone":
        poses = phone.device_poses()
        metadata |= {POSES_BY: "a simulated phone", "depth_kind": "z", "depth_unit_m": 0.001}
    source = ArraySource(frames, poses, metadata=metadata)
    return Taken(Recording.of(source, "simulated", "simulated"), stated, points, made.poses)


def _spread(range_m: Float64) -> Float64:
    """Difference of the largest and smallest range around each pixel; NaN at missing ones."""
    size = 2 * EDGE + 1
    padded = np.pad(range_m, EDGE, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (size, size))
    return np.ptp(around, axis=(2, 3))


def true_places(taken: Taken, poses: Float64, vertices: Float64) -> tuple[Float64, Float64]:
    """Return the true places (V, 3) of vertices, and which frames (V, F) measured them.

    Parameters
    ----------
    poses
        (F, 4, 4) as estimated, NaN where there is none.
    vertices
        (V, 3) of the model.
    """
    total = np.zeros_like(vertices)
    seen = np.zeros((len(vertices), len(poses)), np.bool_)
    for k in np.flatnonzero(np.isfinite(poses[:, 0, 0])):
        points, camera = taken.points[k], taken.camera
        place = se3.transform(se3.inverse(poses[k]), vertices)
        pixel = np.nan_to_num(camera.project(place), nan=-1)
        low = np.floor(pixel).astype(int)
        edge = np.array([camera.width, camera.height]) - EDGE - 1
        inside = ((low >= EDGE) & (low < edge)).all(1)
        u, v = np.where(inside[:, None], low, 0).T
        a, b = np.where(inside[:, None], pixel - low, 0).T[..., None]
        corners = [points[v, u], points[v, u + 1], points[v + 1, u], points[v + 1, u + 1]]
        q = (1 - b) * ((1 - a) * corners[0] + a * corners[1])
        q += b * ((1 - a) * corners[2] + a * corners[3])
        range_m = np.linalg.norm(points - taken.poses[k, :3, 3], axis=2)
        depth = np.linalg.norm(place, axis=1)
        near = np.abs(range_m[v, u] - depth) < 0.05 + 0.05 * depth
        ok = inside & near & (_spread(range_m)[v, u] < JUMP * depth)
        total[ok] += q[ok]
        seen[ok, k] = True
    return total / np.maximum(seen.sum(1), 1)[:, None], seen


@dataclass(frozen=True, eq=False)
class Measured:
    """Lengths of one kind: errors and half widths of their 95 % intervals, m; inf if unbounded."""

    errors: Float64
    bounds: Float64

    def cells(self) -> str:
        """Return the cells of a row of the table."""
        bounded = np.isfinite(self.bounds)
        if not bounded.any():
            return f"{len(self.errors)} | 0 % | - | - | - | -"
        error, bound = np.abs(self.errors[bounded]), self.bounds[bounded]
        median = float(np.median(error))
        return (
            f"{len(self.errors)} | {bounded.mean():.0%} | {(error <= bound).mean():.0%} | "
            f"{1e3 * median:.1f} | {1e3 * np.median(bound):.1f} | {np.median(bound) / median:.1f}"
        )


def measured(taken: Taken, result: Result, frame: RangeFrame) -> dict[str, Measured]:
    """Measure random lengths in a model, by kind of pair."""
    errors = LengthErrors.of(result, frame)
    if errors is None or result.mesh is None:
        return {}
    rng = np.random.default_rng(0)
    rows = rng.permutation(len(result.mesh.vertices))[:VERTICES]
    vertices = result.mesh.vertices[rows].astype(float)
    true, seen = true_places(taken, result.trajectory, vertices)
    count = seen.sum(1)
    known = count >= VIEWS
    vertices, true, seen, count = vertices[known], true[known], seen[known], count[known]
    i, j = np.triu_indices(len(vertices), 1)
    length = np.linalg.norm(vertices[i] - vertices[j], axis=1)
    i, j = i[length > MIN_LENGTH], j[length > MIN_LENGTH]
    common = (seen[i] & seen[j]).sum(1) / np.minimum(count[i], count[j])
    out, above = {}, np.inf
    for kind, least in KINDS.items():
        chosen = np.flatnonzero((common > least) & (common <= above))
        above = least
        chosen = rng.permutation(chosen)[:PAIRS]
        lengths = [errors.between(vertices[i[k]], vertices[j[k]]) for k in chosen]
        truth = np.linalg.norm(true[i[chosen]] - true[j[chosen]], axis=1)
        out[kind] = Measured(
            np.array([one.length_m for one in lengths]) - truth,
            np.array([one.bound_m for one in lengths]),
        )
    return out


def table(results: Iterable[tuple[str, dict[str, Measured]]]) -> None:
    """Print the table of simulated recordings."""
    print(f"| recording | points in | {TITLES} |")
    print("|---|---|---|---|---|---|---|---|")
    every: dict[str, list[Measured]] = {}
    for name, kinds in results:
        for kind, found in kinds.items():
            print(f"| {name} | {kind} | {found.cells()} |", flush=True)
            every.setdefault(kind, []).append(found)
    for kind, found in [*every.items(), ("", [m for of_kind in every.values() for m in of_kind])]:
        errors, bounds = (
            np.concatenate([getattr(m, n) for m in found]) for n in ("errors", "bounds")
        )
        print(f"| all | {kind} | {Measured(errors, bounds).cells()} |")


def named(run: tuple[str, str, float, float, int]) -> str:
    """Return the name of a run for the table."""
    case, camera, focal, scale, _ = run
    wrong = "" if focal == 1 else f", focal length {focal - 1:+.0%}"
    return f"{case}, {camera}{wrong}, depth {scale - 1:+.1%}"


def simulate(run: tuple[str, str, float, float, int]) -> tuple[str, dict[str, Measured]]:
    """Simulate, reconstruct and measure."""
    case, camera, focal, scale, seed = run
    taken = simulated(CASES[case], camera, focal, scale, seed)
    result = reconstruct(taken.recording)
    frame = taken.recording.first_readable()
    assert isinstance(frame, RangeFrame)
    return named(run), measured(taken, result, frame)


def recorded(folder: Path, every: int) -> None:
    """Print the row of the tags, of all pairs of their corners."""
    recording = open_recording(folder).select(every=every)
    result = reconstruct(recording)
    true_of = true_corners(recording)
    tapped: dict[tuple[int, int], list[Float64]] = {}
    for frame, T in zip(recording, result.trajectory, strict=True):
        assert isinstance(frame, RangeFrame)
        for key, (x, y), ray in _corners(frame):
            u, v = round(x), round(y)
            z = frame.z[v - 2 : v + 3, u - 2 : u + 3]
            if z.size == 25 and (z > 0).all():
                place = ray * np.median(z)
                tapped.setdefault(key, []).append(se3.transform(T, place[None])[0])
    corners = [key for key in true_of if key in tapped]
    true = np.array([true_of[key] for key in corners])
    places = np.array([np.mean(tapped[key], axis=0) for key in corners])
    errors = LengthErrors.of(result, recording.first_readable())
    assert errors is not None
    i, j = np.triu_indices(len(corners), 1)
    lengths = [errors.between(places[a], places[b]) for a, b in zip(i, j, strict=True)]
    truth = np.linalg.norm(true[i] - true[j], axis=1)
    found_m = np.array([one.length_m for one in lengths])
    print(f"corners: {len(corners)}, lengths: {truth.min():.3f} to {truth.max():.3f} m")
    print(f"mean relative error: {np.mean(found_m / truth - 1):+.2%}")
    print(f"| recording | {TITLES} |")
    print("|---|---|---|---|---|---|---|")
    bounds = np.array([one.bound_m for one in lengths])
    print(f"| azure_kinect_tags | {Measured(found_m - truth, bounds).cells()} |")


def true_corners(recording: Recording) -> dict[tuple[int, int], Float64]:
    """Return the corners of tags that most colour images show, by the true poses: (3,) each."""
    assert recording.reference is not None
    rays: dict[tuple[int, int], list[tuple[Float64, Float64]]] = {}
    for frame, T in zip(recording, recording.reference, strict=True):
        assert isinstance(frame, RangeFrame)
        for key, _, ray in _corners(frame):
            rays.setdefault(key, []).append((T[:3, 3], T[:3, :3] @ ray))
    return {key: _nearest(lines) for key, lines in rays.items() if len(lines) > len(recording) / 2}


def _corners(frame: RangeFrame) -> Iterator[tuple[tuple[int, int], Float64, Float64]]:
    """Yield tag and number, pixel (2,) and ray (3,) of each corner of a tag in a colour image."""
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(TAGS))
    assert frame.color_image is not None
    found, ids, _ = detector.detectMarkers(frame.color_image)
    for of_tag, tag in zip(found, [] if ids is None else ids.ravel().tolist(), strict=True):
        for k, pixel in enumerate(of_tag[0].astype(float)):
            xy = cv2.remap(frame.camera.rays(), *np.float32(pixel)[:, None, None], 1)[0, 0]
            yield (tag, k), pixel, np.append(xy.astype(float), 1.0)


def _nearest(lines: Sequence[tuple[Float64, Float64]]) -> Float64:
    """Return the point (3,) nearest to lines, each a point and a direction."""
    A, y = np.zeros((3, 3)), np.zeros(3)
    for start, direction in lines:
        d = direction / np.linalg.norm(direction)
        across = np.eye(3) - np.outer(d, d)
        A, y = A + across, y + across @ start
    return np.asarray(np.linalg.solve(A, y), np.float64)


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("simulated", "recorded"))
    parser.add_argument("--only", type=int, default=len(RUNS), help="number of recordings")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--every", type=int, default=4, help="use every N-th recorded frame")
    options = parser.parse_args()
    if options.what == "simulated":
        table(map(simulate, RUNS[: options.only]))
    else:
        recorded(options.data / "azure_kinect_tags", options.every)


if __name__ == "__main__":
    main()
