"""Recordings whose poses can't be right, or can't be known to be; part of `nonsense.py`.

Small simulated recordings with true poses, damaged so that a program may believe what is not so: a
lens that was not used, depth that means something else, surfaces that move with the camera, scenes
that look alike after one step. The true poses are those of the simulated camera.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

import corrupted_frames
import stress
import unusual
import variants
from tofuse.engine.arrays import Float32
from tofuse.engine.frames.frames import RangeFrame
from tofuse.lab.scenes.composition import Assembly
from tofuse.lab.world import mesh as meshes
from tofuse.lab.world import paths
from unusual import GROUND, THINGS, TILES, UNUSUAL, WALL, Unusual
from variants import Take

FRAMES = 48
CAMERA = unusual.pinhole("ifm-o3r", 80, 60, 60)

# Images alone can't show these: the scene may as well be of another size, or the mirrored one, or
# what fills the view may as well stand still.
ASSUMED = frozenset({"constant scale", "mirrored", "nothing else in view"})
# Here a violated bound is as bad as a wrong result that is called good.
BOUNDED = frozenset({"part that moves with the camera", "majority that moves", "somebody near"})


@dataclass(frozen=True)
class Situation:
    """A recording, as a function of the seed, and what is wrong with it."""

    family: str
    name: str
    make: Callable[[int], Take]


# ---- Recordings ----------------------------------------------------------------------------------


@cache
def room(seed: int, rate_hz: float = 15.0, frames: int = FRAMES) -> Take:
    """Stand in a furnished room and rotate slowly."""
    one = replace(UNUSUAL["80 x 60 pixels"], rate_hz=rate_hz, frames=frames)
    return _simulated(one, seed)


@cache
def flat(seed: int) -> Take:
    """Walk through a flat."""
    one = replace(UNUSUAL["elsewhere in the flat"], camera=CAMERA, frames=FRAMES)
    return _simulated(one, seed)


def _simulated(one: Unusual, seed: int) -> Take:
    recording = unusual.record(one, seed)
    return variants.take_of(recording, recording.reference)


def _each(change: Callable[[RangeFrame], RangeFrame]) -> Callable[[int], Take]:
    return lambda seed: room(seed).each(change)


def _numbered(
    change: Callable[[RangeFrame, float], RangeFrame], scene: Callable[[int], Take] = room
) -> Callable[[int], Take]:
    """Change each frame, given its position in the recording: 0 to 1."""

    def make(seed: int) -> Take:
        take = scene(seed)
        last = len(take) - 1
        return replace(take, frames=tuple(change(f, k / last) for k, f in enumerate(take.frames)))

    return make


# ---- The lens, and the meaning of depth ----------------------------------------------------------


def _lens() -> Iterator[tuple[str, Callable[[int], Take]]]:
    factors = (0.7, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 1.3)
    stated = {f"focal length x {x:g}": {"fx": x, "fy": x} for x in factors}
    for axis in ("fx", "fy"):
        stated |= {f"{axis} x {x:g}": {axis: x} for x in (0.8, 0.9, 1.1, 1.2)}
    stated |= {f"cx off by {x:.0%} of fx": {"cx": x} for x in (0.05, 0.1, 0.2, 0.3)}
    stated |= {f"k1 of {x:g}, untrue": {"k1": x} for x in (-0.2, -0.1, 0.1, 0.15)}
    for name, wrong in stated.items():
        yield name, _each(partial(stress.lens_off, **wrong))


def _constant_scale() -> Iterator[tuple[str, Callable[[int], Take]]]:
    for factor in (0.25, 0.5, 0.8, 0.9, 1.1, 1.25, 2, 1000):
        yield f"depth x {factor:g}", _each(corrupted_frames.scaled(factor))


def _mirrored() -> Iterator[tuple[str, Callable[[int], Take]]]:
    for name in ("mirrored left to right", "mirrored top to bottom"):
        mirror = corrupted_frames.CORRUPTIONS[name]
        yield f"depth and amplitude {name}", _each(mirror)
        yield f"depth alone, {name}", _each(lambda f, m=mirror: m(variants.depth_only(f)))


def _meaning() -> Iterator[tuple[str, Callable[[int], Take]]]:
    yield (
        "range taken for z, or z for range",
        _each(lambda f: replace(f, depth_kind="z" if f.depth_kind == "range" else "range")),
    )
    for power in (0.85, 1.15):
        yield f"depth to the power of {power:g}", _each(partial(_gamma, power=power))
    for metres in (0.05, 0.1):
        yield f"depth in steps of {metres:g} m", _each(partial(variants.quantised, metres=metres))
    for metres in (2.0, 2.5):
        yield f"range repeats after {metres:g} m, unstated", _each(partial(_wrapped, metres=metres))
    for pixels in (1, 2, 4):
        yield f"image jumps by {pixels} pixels", _each(partial(_jittered, pixels=pixels))
    mismatched = corrupted_frames.CORRUPTIONS["mirrored left to right"]
    yield (
        "depth mirrored, amplitude not",
        _each(lambda f: replace(mismatched(f), amplitude_image=f.amplitude_image)),
    )


def _gamma(frame: RangeFrame, power: float) -> RangeFrame:
    middle = np.float32(2.0)
    return replace(frame, depth=(middle * (frame.depth / middle) ** power).astype(np.float32))


def _wrapped(frame: RangeFrame, metres: float) -> RangeFrame:
    return replace(frame, depth=np.mod(frame.depth, np.float32(metres)), ambiguity_m=None)


def _jittered(frame: RangeFrame, pixels: int) -> RangeFrame:
    """Move the image, as an image stabiliser does."""
    step = np.random.default_rng([3, frame.index]).integers(-pixels, pixels + 1, 2)
    amplitude = frame.amplitude_image
    return replace(
        frame,
        depth=np.roll(frame.depth, step, (0, 1)),
        amplitude_image=None if amplitude is None else np.roll(amplitude, step, (0, 1)),
    )


# ---- A camera that changes -----------------------------------------------------------------------


def _changing() -> Iterator[tuple[str, Callable[[int], Take]]]:
    for factor in (0.9, 0.95, 0.98, 1.02, 1.05, 1.1):
        yield f"depth x {factor:g} in the second half", _numbered(_later(factor, 0.5))
    for start, where in ((2 / 3, "in the last third"), (1 / 4, "after a quarter")):
        yield f"depth x 1.05 {where}", _numbered(_later(1.05, start))
        yield f"depth x 1.05 {where}, flat", _numbered(_later(1.05, start), flat)
    for factor in (0.9, 0.95, 1.05, 1.1):
        yield f"depth drifts to x {factor:g}", _numbered(_drifting(factor))
    yield "depth drifts to x 1.1, flat", _numbered(_drifting(1.1), flat)
    for metres in (0.05, 0.15):
        yield (
            f"range grows by {metres:g} m",
            _numbered(lambda f, at, m=metres: stress.farther(f, m * at)),
        )
    yield "range grows by 0.1 m, flat", _numbered(lambda f, at: stress.farther(f, 0.1 * at), flat)
    yield (
        "focal length x 1.05 in the second half",
        _numbered(lambda f, at: stress.lens_off(f, fx=1.05, fy=1.05) if at > 0.5 else f),
    )


def _later(factor: float, start: float) -> Callable[[RangeFrame, float], RangeFrame]:
    scale = corrupted_frames.scaled(factor)
    return lambda frame, at: scale(frame) if at > start else frame


def _drifting(factor: float) -> Callable[[RangeFrame, float], RangeFrame]:
    return lambda frame, at: corrupted_frames.scaled(1 + (factor - 1) * at)(frame)


# ---- What moves ----------------------------------------------------------------------------------


def _carried() -> Iterator[tuple[str, Callable[[int], Take]]]:
    for fraction in (0.2, 0.35, 0.5):
        for side in ("below", "left"):
            yield (
                f"textured part, {fraction:.0%} of the image, {side}",
                partial(_with_part, fraction=fraction, side=side),
            )
    for fraction in (0.2, 0.5):
        yield (
            f"smooth part, {fraction:.0%} of the image",
            partial(_with_part, fraction=fraction, side="left", smooth=True),
        )


def _with_part(seed: int, fraction: float, side: str, *, smooth: bool = False) -> Take:
    """Cover a part of all images by a surface that moves with the camera."""
    take, pattern = room(seed), flat(seed).frames[0]
    height, width = pattern.depth.shape
    v, u = np.mgrid[:height, :width]
    part = v >= (1 - fraction) * height if side == "below" else u < fraction * width
    relief = 0.5 + 0.02 * np.sin(u / 9) + 0.03 * np.cos(v / 13)
    surface = relief if smooth else 0.5 * np.where(pattern.depth > 0, pattern.depth, 2.0)

    def change(frame: RangeFrame) -> RangeFrame:
        rng = np.random.default_rng([5, frame.index])
        depth = surface + rng.normal(0, 0.003, surface.shape)
        amplitude = frame.amplitude_image
        if amplitude is not None and pattern.amplitude_image is not None:
            amplitude = np.where(part, pattern.amplitude_image, amplitude)
        return replace(
            frame,
            depth=np.where(part, depth, frame.depth).astype(np.float32),
            amplitude_image=amplitude,
        )

    return take.each(change)


def _moving() -> Iterator[tuple[str, Callable[[int], Take]]]:
    for speed in (0.15, 0.4):
        moving = _train(speed, 3.0)
        yield f"a train passes behind a pillar, {speed:g} m/s", partial(_still, moving=moving)
    yield "a train passes, half of the image", partial(_still, moving=_train(0.3, 1.3))
    for people in (15, 40):
        moving = _crowd(people)
        yield f"a crowd of {people} walks past", partial(_still, moving=moving)
        yield f"a crowd of {people}, bare wall", partial(_still, moving=moving, pillar=False)
    yield "a conveyor with boxes", partial(_still, moving=_conveyor(0.2))


def _filled() -> Iterator[tuple[str, Callable[[int], Take]]]:
    for speed in (0.15, 0.4):
        moving = _train(speed, 3.0)
        yield f"a train fills the view, {speed:g} m/s", partial(_still, moving=moving, pillar=False)


Moving = tuple[tuple[unusual.Material, meshes.Mesh, paths.Path], ...]


def _still(seed: int, moving: Moving, *, pillar: bool = True) -> Take:
    """A still camera before a wall and a pillar, with something that moves along the wall."""
    eye = paths.look_at((0, 0, 1.5), (0, 1, 1.4))
    scene = unusual.built("platform", partial(_platform, pillar=pillar))
    return _simulated(
        Unusual(scene, lambda _: paths.still(eye), CAMERA, FRAMES, moving=moving), seed
    )


def _platform(assembly: Assembly, _rng: np.random.Generator, *, pillar: bool) -> None:
    assembly.add(WALL, meshes.quad((-8, 3.5, -1), (16, 0, 0), (0, 0, 5)))
    assembly.add(GROUND, meshes.quad((-8, -2, 0), (16, 0, 0), (0, 3.2, 0)))
    if pillar:
        assembly.add(THINGS[1], meshes.box((0.35, 0.2, 3), (0.35, 1.1, 1.5)))


def _along(x: float, y: float, z: float, speed: float) -> paths.Path:
    """Move along the wall from x, m."""
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return unusual.straight(T, (speed, 0, 0))


def _train(speed: float, height: float) -> Moving:
    """A train with windows and doors that stand out, of some height."""
    parts = [meshes.box((30, 0.6, height), (0, 0, height / 2))]
    rng = np.random.default_rng(8)
    for x in np.arange(-14, 14, 0.7):
        size = rng.uniform((0.2, 0.1, 0.2), (0.5, 0.5, 0.8 * height))
        parts.append(meshes.box(size, (x, -0.3, rng.uniform(0.3, 0.8) * height)))
    path = _along(-3.0, 2.4, 0.0, speed)
    return ((THINGS[2], parts[0], path), (THINGS[4], meshes.joined(parts[1:]), path))


def _crowd(people: int) -> Moving:
    """People who walk in one direction at one speed."""
    rng = np.random.default_rng(9)
    found = []
    for k in range(people):
        trunk = meshes.superellipsoid((0.3, 0.45, 1.5), (0.6, 0.8)).translated(0, 0, 0.8)
        head = meshes.superellipsoid((0.2, 0.18, 0.25)).translated(0, 0, 1.65)
        path = _along(rng.uniform(-3.5, 2.0), rng.uniform(1.6, 3.0), 0.0, 0.4)
        found.append((THINGS[k % 5], meshes.joined([trunk, head]), path))
    return tuple(found)


def _conveyor(speed: float) -> Moving:
    rng = np.random.default_rng(10)
    boxes = [meshes.box((12, 1.2, 0.1), (0, 0, 0.7))]
    for x in np.arange(-5, 5, 0.5):
        size = rng.uniform(0.15, 0.45, 3)
        boxes.append(meshes.box(size, (x, rng.uniform(-0.3, 0.3), 0.75 + size[2] / 2)))
    path = _along(0.0, 1.7, 0.0, speed)
    return tuple((THINGS[k % 5], box, path) for k, box in enumerate(boxes))


# ---- Somebody near -------------------------------------------------------------------------------

_ENTERS_S, _LEAVES_S, _STEP_S = 1.1, 2.4, 0.4


def _near() -> Iterator[tuple[str, Callable[[int], Take]]]:
    for furnished in (False, True):
        for moves in (False, True):
            for metres in (0.4, 0.6, 0.9, 1.3):
                yield (
                    f"at {metres:g} m before a {'room' if furnished else 'bare wall'}, camera "
                    f"{'moves' if moves else 'stands'}",
                    partial(_somebody, metres=metres, furnished=furnished, moves=moves),
                )


def _somebody(seed: int, metres: float, furnished: bool, moves: bool) -> Take:
    """Somebody enters the view, sways and turns there, and leaves."""
    one = replace(UNUSUAL["80 x 60 pixels"], camera=CAMERA, frames=FRAMES)
    path = one.path(seed)
    if not furnished:
        scene = unusual.built("corner", _corner)
        eye = paths.look_at((0, 0, 1.4), (0.4, 2, 1.2))
        one = replace(one, scene=scene)
        path = unusual.straight(eye, (0.12, 0.05, 0.02))
    start = path(0.0)
    camera = path if moves else paths.still(start)
    rng = np.random.default_rng([seed, 12])
    side, phase = rng.choice((-1, 1)), rng.uniform(0, 6)

    def body(t: float, lag: float = 0.0) -> np.ndarray:
        T = camera(t)
        shown = paths.smooth_step((t - _ENTERS_S) / _STEP_S) - paths.smooth_step(
            (t - _LEAVES_S) / _STEP_S
        )
        heading = np.arctan2(T[1, 2], T[0, 2]) + 1.2 * side * (1 - shown)
        ahead = metres * (1 + 0.1 * np.sin(2.5 * t + phase)) * np.array(
            [np.cos(heading), np.sin(heading), 0]
        )  # fmt: skip
        out = paths.rotation([0, 0, heading + 0.5 * np.sin(1.5 * t + phase + lag)])
        out[:3, 3] = T[:3, 3] + ahead - (0, 0, 1.25)
        if shown <= 0:
            out[2, 3] = -100
        return out

    trunk = meshes.superellipsoid((0.25, 0.42, 0.62), (0.6, 0.8)).translated(0, 0, 1.2)
    head = meshes.superellipsoid((0.2, 0.17, 0.25)).translated(0, 0, 1.64)
    arm = meshes.rod((0.05, 0.26, 1.43), (0.3, 0.2, 1.15), 0.05)
    moving = (
        (THINGS[1], meshes.joined([trunk, head]), body),
        (THINGS[3], arm, partial(body, lag=0.8)),
    )
    return _simulated(replace(one, path=lambda _: camera, moving=moving), seed)


def _corner(assembly: Assembly, _rng: np.random.Generator) -> None:
    """A bare wall that ends at a doorway."""
    assembly.add(WALL, meshes.quad((-5, 2.2, 0), (6.2, 0, 0), (0, 0, 3)))
    assembly.add(WALL, meshes.quad((1.2, 2.2, 0), (0, 3, 0), (0, 0, 3)))
    assembly.add(WALL, meshes.quad((-5, 5.2, 0), (12, 0, 0), (0, 0, 3)))
    assembly.add(GROUND, meshes.quad((-5, -2, 0), (12, 0, 0), (0, 8, 0)))


# ---- Scenes that look alike after one step -------------------------------------------------------

STAIR_M, BAY_M, TILE_M = 0.28, 1.2, 0.3


def _aliasing() -> Iterator[tuple[str, Callable[[int], Take]]]:
    for steps in (0.93, 1.0, 1.07):
        rate = 0.5 / STAIR_M / steps
        stairs = replace(UNUSUAL["up the stairs"], camera=CAMERA, rate_hz=rate, frames=20)
        yield f"stairs, {steps:g} steps an image", partial(_simulated, stairs)
        spiral = replace(UNUSUAL["stairwell"], camera=CAMERA, rate_hz=2 / steps, frames=FRAMES)
        yield f"spiral stairs, {steps:g} steps an image", partial(_simulated, spiral)
        shelves = replace(
            UNUSUAL["aisle of identical shelves"],
            path=unusual.fixed(
                unusual.straight(paths.look_at((0, 0.05, 1.4), (1, 0.25, 1.2)), (0.5, 0, 0))
            ),
            camera=CAMERA,
            rate_hz=0.5 / BAY_M / steps,
            frames=7,
        )
        yield f"shelves, {steps:g} bays an image", partial(_simulated, shelves)
        tiles = Unusual(
            unusual.built("tiles", _tiles),
            unusual.fixed(unusual.straight(paths.look_at((0, 0, 1.6), (0.6, 0.1, 0)), (0.5, 0, 0))),
            CAMERA,
            24,
            0.5 / TILE_M / steps,
        )
        yield f"tiles, {steps:g} tiles an image", partial(_simulated, tiles)


def _tiles(assembly: Assembly, _rng: np.random.Generator) -> None:
    """Add a floor of equal tiles, 2 cm high, with grooves between them."""
    assembly.add(GROUND, meshes.quad((-5, -4, -0.02), (20, 0, 0), (0, 8, 0)))
    for x in np.arange(-2, 11, TILE_M):
        for y in np.arange(-3, 3, TILE_M):
            assembly.add(TILES, meshes.box((0.9 * TILE_M, 0.9 * TILE_M, 0.02), (x, y, -0.01)))


# ---- Images that don't belong together -----------------------------------------------------------


def _amplitude() -> Iterator[tuple[str, Callable[[int], Take]]]:
    for late in (1, 2, 4, 8):
        yield f"amplitude {late} frames late", partial(_with_amplitude, late=late)
    yield "amplitude of the first frame", partial(_with_amplitude, late=FRAMES)
    yield "constant amplitude", _each(_uniform)
    yield "inverted amplitude", _each(_inverted)
    yield "amplitude of another recording", _of_other


def _with_amplitude(seed: int, late: int) -> Take:
    take = room(seed)
    frames = [
        replace(f, amplitude_image=take.frames[max(0, k - late)].amplitude_image)
        for k, f in enumerate(take.frames)
    ]
    return replace(take, frames=tuple(frames))


def _of_other(seed: int) -> Take:
    take, other = room(seed), flat(seed)
    frames = [
        replace(f, amplitude_image=g.amplitude_image)
        for f, g in zip(take.frames, other.frames, strict=True)
    ]
    return replace(take, frames=tuple(frames))


def _changed_amplitude(frame: RangeFrame, change: Callable[[Float32], Float32]) -> RangeFrame:
    amplitude = frame.amplitude_image
    return replace(frame, amplitude_image=None if amplitude is None else change(amplitude))


def _uniform(frame: RangeFrame) -> RangeFrame:
    return _changed_amplitude(frame, lambda a: np.full_like(a, np.median(a)))


def _inverted(frame: RangeFrame) -> RangeFrame:
    return _changed_amplitude(frame, lambda a: np.maximum(np.percentile(a, 99) - a, 1))


def _shutter() -> Iterator[tuple[str, Callable[[int], Take]]]:
    for bands, rate in ((2, 15.0), (4, 15.0), (4, 7.5), (8, 7.5)):
        yield (
            f"{bands} bands of rows one after the other, {rate:g} Hz",
            partial(_rolling, bands=bands, rate_hz=rate),
        )


def _rolling(seed: int, bands: int, rate_hz: float) -> Take:
    """Images whose bands of rows are of consecutive times; true poses are those of the middle."""
    fine = room(seed, 60.0, 160)
    step = round(60 / rate_hz)
    height = fine.frames[0].depth.shape[0]
    of_row = np.arange(height) * bands // height * step // bands
    rows = np.arange(height)
    frames = []
    starts = range(0, len(fine) - step, step)
    for start in starts:
        depth = np.stack([f.depth for f in fine.frames[start : start + step]])
        amplitude = np.stack([f.amplitude_image for f in fine.frames[start : start + step]])
        frames.append(
            replace(
                fine.frames[start],
                depth=depth[of_row, rows],
                amplitude_image=amplitude[of_row, rows],
            )
        )
    return replace(
        fine, frames=tuple(frames), poses=fine.poses[[start + step // 2 for start in starts]]
    )


def _smoothing() -> Iterator[tuple[str, Callable[[int], Take]]]:
    for weight in (0.7, 0.5, 0.3, 0.15):
        yield f"exponential mean, weight {weight:g}", partial(_averaged, weight=weight)
    yield "median of five frames", _medians


def _averaged(seed: int, weight: float) -> Take:
    """Average depth over time, as a filter in the camera that ignores motion."""
    take = room(seed)
    frames, mean = [], take.frames[0].depth
    for frame in take.frames:
        both = (frame.depth > 0) & (mean > 0)
        mean = np.where(both, weight * frame.depth + (1 - weight) * mean, frame.depth)
        frames.append(replace(frame, depth=mean.astype(np.float32)))
    return replace(take, frames=tuple(frames))


def _medians(seed: int) -> Take:
    take = room(seed)
    depth = np.stack([frame.depth for frame in take.frames])
    frames = [
        replace(f, depth=np.median(depth[max(0, k - 4) : k + 1], axis=0).astype(np.float32))
        for k, f in enumerate(take.frames)
    ]
    return replace(take, frames=tuple(frames))


def _splicing() -> Iterator[tuple[str, Callable[[int], Take]]]:
    half, order = FRAMES // 2, np.arange(FRAMES)
    yield "another place from the middle on", lambda seed: stress.two_places(room(seed), _far(seed))
    for step in (3, 8):
        yield f"one frame in {step} of another place", partial(_mixed, step=step)
    yield (
        "random order",
        lambda seed: stress.shuffled(room(seed), np.random.default_rng([seed, 6])),
    )
    yield (
        "two halves interleaved",
        lambda seed: room(seed).at(order.reshape(2, half).T.ravel()),
    )
    yield "halves exchanged", lambda seed: room(seed).at(np.roll(order, half))


def _far(seed: int) -> Take:
    """Another place, without a connection."""
    other = flat(seed)
    poses = other.poses.copy()
    poses[:, 0, 3] += stress.APART_M
    return replace(other, poses=poses)


def _mixed(seed: int, step: int) -> Take:
    take, other = room(seed), _far(seed)
    foreign = np.arange(len(take)) % step == step - 1
    pairs = zip(take.frames, other.frames, foreign, strict=True)
    return replace(
        take,
        frames=tuple(replace(g, timestamp=f.timestamp) if is_other else f
                     for f, g, is_other in pairs),
        poses=np.where(foreign[:, None, None], other.poses, take.poses),
    )  # fmt: skip


def _repeating() -> Iterator[tuple[str, Callable[[int], Take]]]:
    n = np.arange(FRAMES)
    yield "each frame twice", lambda seed: room(seed).at(np.repeat(n, 2))
    held = {
        "every second image instead of its successor": n - n % 2,
        "every third image held for three frames": n - n % 3,
        "one image held for ten frames": np.where((n > 20) & (n < 30), 20, n),
        "one image held in the second half": np.minimum(n, FRAMES // 2),
    }
    for name, shown in held.items():
        yield name, partial(_held, shown=tuple(shown.tolist()))


def _held(seed: int, shown: tuple[int, ...]) -> Take:
    """Images that are not new, although the camera moves on."""
    take = room(seed)
    frames = [
        replace(take.frames[k], timestamp=f.timestamp)
        for k, f in zip(shown, take.frames, strict=True)
    ]
    return replace(take, frames=tuple(frames))


_FAMILIES = {
    "lens": _lens,
    "meaning of depth": _meaning,
    "constant scale": _constant_scale,
    "mirrored": _mirrored,
    "range that changes": _changing,
    "part that moves with the camera": _carried,
    "majority that moves": _moving,
    "nothing else in view": _filled,
    "somebody near": _near,
    "aliasing": _aliasing,
    "amplitude": _amplitude,
    "rolling shutter": _shutter,
    "smoothed depth": _smoothing,
    "spliced": _splicing,
    "repeated": _repeating,
}


def situations() -> list[Situation]:
    """Return all situations, by family."""
    return [
        Situation(family, name, make)
        for family, members in _FAMILIES.items()
        for name, make in members()
    ]
