"""Global registration of two range images: success of `tofuse.register`, and its calibration.

`table` prints, by the gap in frames, how many poses are right (within 0.1 m and 4 degrees), how
many of those are accepted, and how many are accepted and wrong; also for Open3D's RANSAC over FPFH
with point-to-plane ICP, if installed. `fit` fits the logistic models of
`tofuse.engine.search.pose_probability` to simulated pairs, some of them without overlap, and prints
their coefficients, with area under the ROC curve and calibration on held-out scenes. For these
models a pose is right within 5 % of the depth and 4 degrees. `cameras` tests the models on the
other cameras and scenes of `pair_views`, compared with models fitted on all of these except the
camera itself.
`methods` compares the choice of `tofuse.register` for each pair with each of its candidate methods,
and with an oracle that picks a right one if there is any.

    python benchmarks/pairs.py table [--data ../shared/data] [--scenes room kitchen]
    python benchmarks/pairs.py fit
    python benchmarks/pairs.py cameras
    python benchmarks/pairs.py methods

Simulated scenes are made once and kept in benchmarks/out/recordings/pairs.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Unpack

import numpy as np

import sequences
import tofuse
from pair_views import TAKEN, recorded
from peers import o3d_global
from scoring import roc_area
from sequences import DATA, kinect_loop
from tofuse.engine.alignment.base import Registration
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.clouds.cloud_pair import register_clouds
from tofuse.engine.clouds.pair import AnyPair
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import Recording
from tofuse.engine.geometry import se3
from tofuse.engine.search.pair_agreement import agreement
from tofuse.engine.search.pose_probability import (
    ACCEPTED,
    IMAGES,
    RIGHT_FRACTION,
    RIGHT_RAD,
    PoseEvidence,
    logistic,
)
from tofuse.engine.search.view_pair import follow, register_pair
from tofuse.engine.views.prepared_view import PreparedView, prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.lab.simulation.record import PlanOptions

RIGHT_M, RIGHT_DEG = 0.1, 4.0
# Ridge penalty: keeps coefficients finite where few pairs are perfectly separable.
_RIDGE = 0.1
# Views with less overlap than this show different places.
_APART = 0.02
# Errors of the initial guesses, m and degrees, on which the model for followed poses is fitted.
GUESSES = ((0.0, 0.0), (0.1, 4.0), (0.3, 12.0), (0.8, 30.0))
# Gaps between the views that `cameras` registers.
_STEPS = (1, 2, 3, 5)
_BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0)


@dataclass(frozen=True)
class Scene:
    """Views of one scene, and the gaps between the views of its pairs.

    Attributes
    ----------
    every
        Raw frames from one view to the next.
    family
        Scenes of one family show the same place.
    """

    name: str
    title: str
    open: Callable[[Path], Recording] = field(repr=False)
    every: int
    gaps: tuple[int, ...]
    family: str


def _sim(
    name: str, title: str, scene: str, every: int, frames: int, **options: Unpack[PlanOptions]
) -> Scene:
    family = "room" if "room" in scene else scene.removesuffix("-alike")
    opened = sequences.simulated(f"pairs/{name}", scene, **options, every=every, frames=frames)
    gaps = tuple(k for k in (1, 2, 3, 4, 6) if k < frames - 1)
    return Scene(name, title, opened, every, gaps, family)


def _walk(name: str, title: str, camera: str, seed: int) -> Scene:
    """A walk of 1140 frames: pairs of views 10 to 40 frames apart."""
    scene = _sim(name, title, "flat", 10, 114, camera=camera, seed=seed)
    return replace(scene, gaps=(1, 2, 3, 4))


SCENES = {
    scene.name: scene
    for scene in (
        _sim("room", "Furnished room, SR4000", "room", 8, 24),
        _sim("empty-room", "Empty room, SR4000", "empty-room", 8, 24),
        _sim("plain-room", "Empty room, uniform albedo", "empty-room", 8, 24, texture=False),
        _sim("flat", "Flat of four rooms, SR4000", "flat", 12, 48),
        _sim("flat-alike", "Flat with similar rooms, SR4000", "flat-alike", 12, 48, seed=2),
        _walk("flat-flexx", "Walk through a flat, pico flexx", "pico-flexx", 11),
        _walk("flat-o3r", "Walk through a flat, ifm O3R", "ifm-o3r", 12),
        _sim("rail", "Rail, pico flexx", "rail", 40, 7, camera="pico-flexx"),
        _sim("hall", "Hall, ifm O3R", "hall", 12, 12, camera="ifm-o3r"),
        Scene(
            "kitchen",
            "7-Scenes kitchen, Kinect v1",
            sequences.recorded("sevenscenes_kitchen"),
            2,
            (10, 30, 60),
            "kitchen",
        ),
        Scene("kinect", "Loop round boxes, Kinect v2", kinect_loop, 1, (1, 2, 3), "boxes"),
    )
}
# A rotating object in front of a static background.
OBJECTS = {
    scene.name: scene
    for scene in (
        _sim("torso", "Torso, SR4000", "torso", 6, 20),
        _sim("box", "Box, SR4000", "box", 6, 20),
    )
}
# The others are held out, and test how the fit generalises to other cameras.
FITTED = ["room", "empty-room", "plain-room", "flat", "flat-alike"]


@lru_cache
def opened(name: str, data: Path) -> Recording:
    return (SCENES | OBJECTS)[name].open(data)


def chosen(count: int, gap: int, max_pairs: int) -> list[tuple[int, int]]:
    """At most `max_pairs` pairs with a gap, evenly over the recording."""
    starts = np.linspace(0, count - gap - 1, min(max_pairs, max(count - gap, 0)))
    return [(int(i), int(i) + gap) for i in starts]


def _pairs(
    recording: Recording, gap: int, max_pairs: int
) -> Iterator[tuple[RangeFrame, RangeFrame, Float64]]:
    """Sources, targets and true poses of pairs with a gap."""
    T = recording.reference
    for i, j in chosen(len(recording), gap, max_pairs):
        source, target = recording[j], recording[i]
        assert isinstance(source, RangeFrame)
        assert isinstance(target, RangeFrame)
        if T is not None and np.isfinite(T[[i, j]]).all():
            yield source, target, se3.inverse(T[i]) @ T[j]


def pose_error(found: Float64, true: Float64) -> tuple[float, float]:
    """Error of a pose, m and degrees."""
    gap = se3.inverse(true) @ found
    return float(np.linalg.norm(gap[:3, 3])), float(np.degrees(se3.angle(gap)))


@dataclass(frozen=True)
class Outcome:
    """Result for one pair; without a pose the error is infinite."""

    metres: float
    degrees: float
    seconds: float
    accepted: bool = False
    probability: float = 0.0

    @property
    def right(self) -> bool:
        return self.metres < RIGHT_M and self.degrees < RIGHT_DEG


Method = Callable[[RangeFrame, RangeFrame], Registration | Float64]


def outcome(method: Method, source: RangeFrame, target: RangeFrame, true: Float64) -> Outcome:
    """Register one pair, timed including its preparation."""
    start = time.perf_counter()
    try:
        found = method(source, target)
    except RegistrationError:
        return Outcome(np.inf, np.inf, time.perf_counter() - start)
    seconds = time.perf_counter() - start
    if isinstance(found, Registration):
        accepted, probability = bool(found.believed), found.probability or 0.0
        return Outcome(*pose_error(found.T_target_source, true), seconds, accepted, probability)
    return Outcome(*pose_error(found, true), seconds)


def print_table(names: Sequence[str], data: Path, max_pairs: int) -> None:
    """Print success by gap, and the calibration of the probability over all pairs."""
    ours: list[Outcome] = []
    peer = o3d_global.method()
    print(
        "| Views | gap, frames | right | of these accepted | accepted and wrong | s/pair"
        " | Open3D right | s/pair |\n|---|---|---|---|---|---|---|---|"
    )
    for name in names:
        if not _is_there(name, data):
            print(f"| {name}: no data |")
            continue
        for gap in SCENES[name].gaps:
            mine, theirs = [], []
            for source, target, true in _pairs(opened(name, data), gap, max_pairs):
                if not ours:
                    tofuse.register(source, target)  # compiles
                mine.append(outcome(tofuse.register, source, target, true))
                ours.append(mine[-1])
                if peer is not None:
                    theirs.append(outcome(peer, source, target, true))
            print(_row(SCENES[name], gap, mine, theirs), flush=True)
    _print_worth(ours)
    _print_decoys(names, data, max_pairs)
    if peer is None:
        print("\nOpen3D: not installed")


def followed(source: RangeFrame, target: RangeFrame) -> Registration:
    """Local alignment from the identity only."""
    return AnyPair(search=False).register(source, target, np.eye(4), np.random.default_rng(0))


def searched(source: RangeFrame, target: RangeFrame) -> Registration:
    """Exhaustive search on the images only."""
    maps = (prepare_view(frame, SurfaceOptions()) for frame in (source, target))
    found = register_pair(*maps, always_search=True)
    if found is None:
        raise RegistrationError("has too few surfaces", where=f"frame {source.index}")
    return found


def by_shapes(source: RangeFrame, target: RangeFrame) -> Registration:
    """Global registration of the points as clouds."""
    return register_clouds(source, target, None, np.random.default_rng(0), always_search=True)


WAYS: dict[str, Method] = {
    "followed from the identity": followed,
    "images searched": searched,
    "clouds by shapes": by_shapes,
    "chosen (tofuse.register)": tofuse.register,
}


def print_methods(names: Sequence[str], data: Path, max_pairs: int) -> None:
    """Print the successes of each method on all pairs of each scene, and of an oracle."""
    print(f"| Views | pairs | {' | '.join(WAYS)} | oracle |\n|---{'|---' * (len(WAYS) + 2)}|")
    total = np.zeros(len(WAYS) + 2, int)
    seconds: dict[str, list[float]] = {way: [] for way in WAYS}
    for name in names:
        if not _is_there(name, data):
            continue
        counts = np.zeros(len(WAYS) + 2, int)
        for gap in SCENES[name].gaps:
            for source, target, true in _pairs(opened(name, data), gap, max_pairs):
                made = {way: outcome(method, source, target, true) for way, method in WAYS.items()}
                right = [o.right for o in made.values()]
                counts += np.array([1, *right, any(right)])
                for way, o in made.items():
                    seconds[way].append(o.seconds)
        total += counts
        print(f"| {SCENES[name].title} | {' | '.join(map(str, counts))} |", flush=True)
    print(f"| all | {' | '.join(map(str, total))} |")
    medians = (f"{np.median(s):.2f}" for s in seconds.values())
    print(f"| s/pair | | {' | '.join(medians)} | |")


def _print_decoys(names: Sequence[str], data: Path, max_pairs: int) -> None:
    """Print acceptances among pairs of different places; `max_pairs` for each two scenes."""
    rng = np.random.default_rng([1, 4])
    there = [name for name in names if _is_there(name, data)]
    found: list[Registration] = []
    failed = 0
    for k, name in enumerate(there):
        for other in there[k + 1 :]:
            if SCENES[name].family == SCENES[other].family:
                continue
            for _ in range(max_pairs):
                a, b = (opened(n, data) for n in (name, other))
                try:
                    found.append(
                        tofuse.register(a[int(rng.integers(len(a)))], b[int(rng.integers(len(b)))])
                    )
                except RegistrationError:
                    failed += 1
    if found:
        accepted = sum(bool(f.believed) for f in found)
        highest = max(f.probability or 0.0 for f in found)
        print(f"\nof {len(found) + failed} pairs of different places {accepted} accepted,", end=" ")
        print(f"{failed} failed, highest probability {highest:.2f}")


def _is_there(name: str, data: Path) -> bool:
    try:
        opened(name, data)
    except FileNotFoundError:
        return False
    return True


def _row(scene: Scene, gap: int, mine: list[Outcome], theirs: list[Outcome]) -> str:
    right = sum(o.right for o in mine)
    sure = sum(o.right and o.accepted for o in mine)
    wrong = sum(o.accepted and not o.right for o in mine)
    cells = [
        scene.title,
        gap * scene.every,
        f"{right} of {len(mine)}",
        sure,
        wrong,
        f"{np.median([o.seconds for o in mine]):.2f}",
        f"{sum(o.right for o in theirs)} of {len(theirs)}" if theirs else "",
        f"{np.median([o.seconds for o in theirs]):.2f}" if theirs else "",
    ]
    return f"| {' | '.join(map(str, cells))} |"


def _print_worth(found: list[Outcome]) -> None:
    p = np.array([o.probability for o in found])
    right = np.array([o.right for o in found])
    accepted = np.array([o.accepted for o in found])
    wrong = accepted & ~right
    print(f"\n{len(found)} pairs, area under the ROC curve {roc_area(p, right):.3f}")
    print(f"accepted {accepted.sum()}, of these wrong by more than 0.1 m or 4 degrees", end=" ")
    far = sum(o.accepted and (o.metres > 3 * RIGHT_M or o.degrees > 3 * RIGHT_DEG) for o in found)
    print(f"{wrong.sum()}, by more than three times that {far}")
    print_calibration(p, right)


def print_calibration(p: Float64, right: Bool) -> None:
    """Print the fraction of right poses by stated probability."""
    print("\n| probability | pairs | stated | right |\n|---|---|---|---|")
    for low, high in itertools.pairwise(_BINS):
        some = (p >= low) & ((p < high) | (high == 1))
        if some.any():
            stated, seen = p[some].mean(), right[some].mean()
            print(f"| {low:g} to {high:g} | {some.sum()} | {stated:.2f} | {seen:.2f} |")


@dataclass(frozen=True, eq=False)
class Samples:
    """Regressors (n, k) of poses, whether they are right, and indices of their scenes."""

    x: Float64
    right: Bool
    scene: Intp


def samples(max_pairs: int, data: Path) -> tuple[Samples, Samples]:
    """Poses from the search, and poses aligned from initial guesses."""
    searched: list[tuple[Float64, bool, int]] = []
    followed: list[tuple[Float64, bool, int]] = []
    rng = np.random.default_rng([1, 3])
    views = {name: _views(opened(name, data)) for name in FITTED}
    for number, name in enumerate(FITTED):
        maps, T = views[name]
        for gap in SCENES[name].gaps:
            for i, j in chosen(len(maps), gap, max_pairs):
                true = se3.inverse(T[i]) @ T[j]
                _add(searched, followed, maps[j], maps[i], true, number, rng)
        others = [n for n in FITTED if SCENES[n].family != SCENES[name].family]
        for _ in range(max_pairs):
            other = views[others[int(rng.integers(len(others)))]][0]
            source, target = (v[int(rng.integers(len(v)))] for v in (maps, other))
            _add(searched, followed, source, target, None, number, rng)
        print(f"{name}: {len(searched)} searched, {len(followed)} followed so far", flush=True)
    # Loop candidates may be anywhere in a scene, whose rooms and walls look alike.
    rng = np.random.default_rng([5, 1])
    for number, name in enumerate(FITTED):
        maps, T = views[name]
        for _ in range(3 * max_pairs):
            i, j = rng.choice(len(maps), 2, replace=False)
            _add(searched, followed, maps[j], maps[i], se3.inverse(T[i]) @ T[j], number, rng)
    return stacked(searched), stacked(followed)


def _views(recording: Recording) -> tuple[list[PreparedView], Float64]:
    assert recording.reference is not None
    frames = [frame for frame in recording if isinstance(frame, RangeFrame)]
    return [prepare_view(frame, SurfaceOptions()) for frame in frames], recording.reference


def _add(
    searched: list[tuple[Float64, bool, int]],
    followed: list[tuple[Float64, bool, int]],
    source: PreparedView,
    target: PreparedView,
    true: Float64 | None,
    scene: int,
    rng: np.random.Generator,
) -> None:
    """Register a pair without and with initial guesses; without truth every pose is wrong."""

    def is_right(found: Registration) -> bool:
        if true is None or agreement(source, target, true).overlap < _APART:
            return False
        metres, degrees = pose_error(found.T_target_source, true)
        near = metres < RIGHT_FRACTION * 0.5 * (source.depth + target.depth)
        return near and np.radians(degrees) < RIGHT_RAD

    try:
        found = register_pair(source, target, always_search=True)
        if found is not None:
            searched.append((_evidence(found).search_regressors, is_right(found), scene))
        for metres, degrees in GUESSES:
            way = rng.standard_normal((2, 3))
            way *= np.array([[metres], [np.radians(degrees)]]) / np.linalg.norm(
                way, axis=1, keepdims=True
            )
            guess = (np.eye(4) if true is None else true) @ se3.exp(way.ravel())
            near = follow(source, target, guess)
            if near is not None and not len(near.unobservable):
                followed.append((_evidence(near).local_regressors, is_right(near), scene))
    except RegistrationError:
        pass


def _evidence(found: Registration) -> PoseEvidence:
    assert found.support is not None
    assert found.contradiction is not None
    return PoseEvidence(found.support, found.contradiction, found.margin, len(found.unobservable))


def stacked(rows: list[tuple[Float64, bool, int]]) -> Samples:
    x, right, scene = zip(*rows, strict=True)
    return Samples(np.stack(x), np.array(right, bool), np.array(scene))


def fitted(x: Float64, right: Bool, weight: Float64 | float = 1.0) -> Float64:
    """Coefficients of a logistic model by Newton's method; the first regressor is constant."""
    w = np.zeros(x.shape[1])
    ridge = np.diag([0.0] + [_RIDGE] * (len(w) - 1))
    for _ in range(50):
        p = np.array([logistic(float(v)) for v in x @ w])
        hessian = x.T @ (x * (weight * p * (1 - p) + 1e-9)[:, None]) + ridge
        w -= np.linalg.solve(hessian, x.T @ (weight * (p - right)) + ridge @ w)
    return w


def print_fit(title: str, all_of: Samples) -> None:
    """Print coefficients from all pairs, and leave-one-scene-out results."""
    w = fitted(all_of.x, all_of.right)
    print(f"\n{title}: {len(all_of.right)} poses, {all_of.right.sum()} right")
    print(f"coefficients {', '.join(f'{v:.2f}' for v in w)}")
    p = np.empty(len(all_of.right))
    for scene in np.unique(all_of.scene):
        mine = all_of.scene == scene
        other = fitted(all_of.x[~mine], all_of.right[~mine])
        p[mine] = [logistic(float(v)) for v in all_of.x[mine] @ other]
    accepted = p >= ACCEPTED
    print(f"area under the ROC curve {roc_area(p, all_of.right):.3f}, leave-one-scene-out")
    print(f"accepted {accepted.sum()}, of these wrong {(accepted & ~all_of.right).sum()}")
    print_calibration(p, all_of.right)


def print_cameras(max_pairs: int) -> None:
    """Print results by camera of the models in use, and of those fitted without it."""
    searched, followed, cameras = samples_of_cameras(max_pairs)
    for title, poses, coefficients in (
        ("Searched", searched, IMAGES.search),
        ("Followed from a guess", followed, IMAGES.local),
    ):
        print(
            f"\n| {title} | poses | right | area under the ROC curve | right and accepted"
            " | wrong and accepted | the same, fitted without it | | |\n"
            "|---|---|---|---|---|---|---|---|---|"
        )
        in_use = np.array([logistic(float(v)) for v in poses.x @ np.array(coefficients)])
        held_out = np.empty(len(in_use))
        for number, camera in enumerate(cameras):
            mine = poses.scene == number
            w = fitted(poses.x[~mine], poses.right[~mine])
            held_out[mine] = [logistic(float(v)) for v in poses.x[mine] @ w]
            print(_camera_row(camera, poses.right[mine], in_use[mine], held_out[mine]))
        print(_camera_row("all", poses.right, in_use, held_out))
        print_calibration(in_use, poses.right)


def _camera_row(title: str, right: Bool, *probabilities: Float64) -> str:
    cells: list[object] = [title, len(right), right.sum()]
    for p in probabilities:
        accepted = p >= ACCEPTED
        cells += [f"{roc_area(p, right):.3f}", (accepted & right).sum(), (accepted & ~right).sum()]
    return f"| {' | '.join(map(str, cells))} |"


def samples_of_cameras(max_pairs: int) -> tuple[Samples, Samples, list[str]]:
    """Poses from the search, and poses aligned from initial guesses, by camera."""
    searched: list[tuple[Float64, bool, int]] = []
    followed: list[tuple[Float64, bool, int]] = []
    views = {taken: _views(recorded(taken)) for taken in TAKEN}
    cameras = sorted({taken.camera for taken in TAKEN})
    for taken, (maps, T) in views.items():
        number, rng = cameras.index(taken.camera), np.random.default_rng([7, taken.seed])
        within = [pair for gap in _STEPS for pair in chosen(len(maps), gap, max_pairs)]
        for _ in range(max_pairs):
            i, j = rng.choice(len(maps), 2, replace=False)
            within.append((int(i), int(j)))
        for i, j in within:
            true = se3.inverse(T[i]) @ T[j]
            _add(searched, followed, maps[j], maps[i], true, number, rng)
        others = [other for other in TAKEN if other.place != taken.place]
        for k in range(max_pairs):
            # Half of them are from the same camera.
            alike = [other for other in others if other.camera == taken.camera]
            some = alike if k % 2 and alike else others
            other = views[some[int(rng.integers(len(some)))]][0]
            source, target = (v[int(rng.integers(len(v)))] for v in (maps, other))
            _add(searched, followed, source, target, None, number, rng)
        print(f"{taken}: {len(searched)} searched, {len(followed)} followed so far", flush=True)
    return stacked(searched), stacked(followed), cameras


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["table", "fit", "cameras", "methods"])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--scenes", nargs="*", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--pairs", type=int, default=8, help="pairs for each gap")
    given = parser.parse_args(arguments)
    if given.what == "table":
        print_table(given.scenes, given.data, given.pairs)
        return
    if given.what == "methods":
        print_methods(given.scenes, given.data, given.pairs)
        return
    if given.what == "cameras":
        print_cameras(given.pairs)
        return
    of_search, of_guesses = samples(given.pairs, given.data)
    print_fit("Searched: constant, sqrt of margin, sqrt of contradiction, degenerate", of_search)
    print_fit("Followed from a guess: constant, support, sqrt of contradiction", of_guesses)


if __name__ == "__main__":
    main()
