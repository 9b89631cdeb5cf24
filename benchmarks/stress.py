"""Difficult recordings: realistic disturbances, applied to simulated recordings.

The simulated recordings have exact ground truth. They are simulated without multipath and, except
for the quick rotations, without motion smear (slow to simulate, and not the difficulty here), and
kept in `out/recordings/robustness`. The falloff of raw amplitude towards the corners is
compensated, as by a calibrated camera; uncompensated falloff is a separate case. Which frames are
connectable is determined from the ground truth: two frames are tied if each sees at least 35 % of
the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

from made_once import made_once
from scoring import Truth
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.cameras.cameras import BrownConrady
from tofuse.engine.frames.frames import SATURATED_AMPLITUDE, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.simulation.passing import Kind, Passing
from tofuse.lab.simulation.record import plan, write
from tofuse.lab.world import paths
from tofuse.lab.world import scene as simulated

OUT = Path(__file__).resolve().parent / "out" / "recordings" / "robustness"

OVERLAP, NEAR_M = 0.35, 0.10
APART_M = 100.0  # between places without a connection
DURATIONS_S = (0.3, 1.0, 3.0)
FRACTIONS = (0.10, 0.25, 0.40)


@dataclass(frozen=True, eq=False)
class Take:
    """Frames in memory with their true poses (N, 4, 4) T_room_camera."""

    frames: tuple[RangeFrame, ...]
    poses: Float64
    metadata: dict[str, object]

    def __len__(self) -> int:
        return len(self.frames)

    def at(self, chosen: Sequence[int] | Intp) -> Take:
        """Return some of the frames, in the order given."""
        return replace(self, frames=tuple(self.frames[k] for k in chosen), poses=self.poses[chosen])

    @property
    def step_s(self) -> float:
        """Time between frames."""
        return float(np.median(np.diff([frame.timestamp for frame in self.frames])))


@dataclass(frozen=True)
class Scene:
    """Recordings of one scene.

    Attributes
    ----------
    camera
        Name in `simulation.models.CAMERAS`.
    first, frames
        First raw frame, and number of frames.
    elsewhere
        Another place: scene, first raw frame.
    again
        Raw frame from which the recording is back at its start.
    bare
        Position of a camera close to a bare wall, and its target point.
    """

    name: str
    camera: str
    first: int
    frames: int
    elsewhere: tuple[str, int]
    again: int
    bare: tuple[tuple[float, float, float], tuple[float, float, float]]


SCENES = {
    scene.name: scene
    for scene in (
        Scene("room", "sr4000", 0, 128, ("rail", 0), 264, ((-0.15, 1.22, 1.3), (-0.15, 1.6, 1.3))),
        Scene("rail", "sr4000", 0, 63, ("room", 0), 190, ((0.2, 2.6, 1.8), (0.2, 3.0, 1.8))),
        Scene("flat", "ifm-o3r", 0, 110, ("room", 0), 900, ((-2.6, -4.0, 1.3), (-2.6, -4.4, 1.3))),
        # The other place is another room.
        Scene(
            "flat-alike",
            "ifm-o3r",
            0,
            110,
            ("flat-alike", 570),
            900,
            ((-2.6, -4.0, 1.3), (-2.6, -4.4, 1.3)),
        ),
    )
}

STRETCH_S = 1.5  # each: to the bare wall, at it, and back


def take(
    scene: Scene,
    seed: int,
    *,
    passing: Passing | None = None,
    motion: str = "",
    other: tuple[str, int] | None = None,
    frames: int | None = None,
    falloff: bool = False,
) -> Take:
    """Simulate a recording, or read it if it exists.

    Parameters
    ----------
    passing
        Object that passes through the view.
    motion
        "quick turns", "close-up", or empty for the motion of the scene.
    other
        Another scene and its first raw frame, with the same camera.
    falloff
        Whether raw amplitude falls off towards the corners.
    """
    name, first = other or (scene.name, scene.first)
    count = frames or scene.frames
    key = [name, scene.camera, str(first), str(count), str(seed), motion.replace(" ", "-")]
    if passing is not None:
        key += [passing.kind, f"{passing.fraction:.2f}"]
    folder = OUT / "_".join(part for part in key if part)
    hidden = ("multipath",) if motion == "quick turns" else ("multipath", "smear")
    made = plan(
        name,
        camera=scene.camera,
        seed=seed,
        effects=Effects().without(*hidden),
        first=first,
        frames=count,
        passing=passing,
    )
    rate = made.sequence.frame_rate_hz
    start = made.raw[0] / rate
    if motion == "quick turns":
        path = quick_turns(made.sequence.camera_path, start)
        made = replace(made, sequence=replace(made.sequence, camera_path=path))
    elif motion == "close-up":
        path = close_up(made.sequence.camera_path, start + 2.0, paths.look_at(*scene.bare))
        made = replace(made, sequence=replace(made.sequence, camera_path=path))
    recording = open_recording(made_once(folder, partial(write, made)))
    images = tuple(frame for frame in recording if isinstance(frame, RangeFrame))
    if not falloff:
        images = tuple(evenly_lit(frame, made.model.transmission) for frame in images)
    poses = made.sequence.T_room_camera(start) @ made.poses
    return Take(images, poses, dict(recording.metadata))


def evenly_lit(frame: RangeFrame, transmission: Float64) -> RangeFrame:
    """Compensate raw amplitude for the transmission (H, W) of lens and illumination."""
    amplitude = frame.amplitude_image
    if amplitude is None or frame.amplitude_kind != "raw":
        return frame
    even = amplitude / np.where(transmission > 0, transmission, 1.0)
    even = np.where(
        amplitude >= SATURATED_AMPLITUDE, amplitude, np.minimum(even, SATURATED_AMPLITUDE - 1)
    )
    return replace(frame, amplitude_image=even.astype(np.float32))


def quick_turns(path: paths.Path, start: float) -> paths.Path:
    """Rotate by 60 degrees to a side within 0.4 s and back, every 3 s."""

    def turned(t: float) -> Float64:
        u = (t - start) % 3.0
        side = 1 if int((t - start) // 3.0) % 2 else -1
        away = paths.smooth_step((u - 1.2) / 0.4) - paths.smooth_step((u - 2.2) / 0.4)
        return path(t) @ paths.rotation([0, side * np.radians(60) * away, 0])

    return turned


def close_up(path: paths.Path, leave: float, T_room_wall: Float64) -> paths.Path:
    """Leave the path at a time, approach a wall, slide along it, return and continue."""
    T = path(leave)
    way = se3.log(se3.inverse(T) @ T_room_wall)

    def there(t: float) -> Float64:
        u = t - leave
        if u <= 0:
            return path(t)
        if u >= 3 * STRETCH_S:
            return path(t - 3 * STRETCH_S)
        fraction = paths.smooth_step(u / STRETCH_S) - paths.smooth_step(u / STRETCH_S - 2)
        slid = np.array([0.04 * np.sin(2 * np.pi * u / STRETCH_S), 0, 0, 0, 0, 0]) * fraction
        return T @ se3.exp(fraction * way) @ se3.exp(slid)

    return there


@dataclass(frozen=True, eq=False)
class Case:
    """One recording to reconstruct, with its ground truth."""

    scene: str
    name: str
    recording: Recording
    truth: Truth


def groups(frames: Sequence[RangeFrame], poses: Float64, unusable: Sequence[int] = ()) -> Intp:
    """Index (N,) of the group of overlapping frames; -1 if unusable or isolated.

    Parameters
    ----------
    frames
        Frames of the camera; they are subsampled to about 40 x 30 pixels.
    poses
        (N, 4, 4) true poses.
    unusable
        Positions of frames in which the scene is not visible.
    """
    n = len(frames)
    step = max(1, frames[0].depth.shape[1] // 40)
    pick = (slice(step // 2, None, step), slice(step // 2, None, step))
    clouds, images = [], []
    for frame in frames:
        z = frame.z
        xy = frame.camera.rays()[pick].reshape(-1, 2).astype(float)
        flat = z[pick].reshape(-1)
        good = (flat > 0) & np.isfinite(xy).all(1)
        clouds.append(homogeneous(xy[good]) * flat[good, None])
        images.append(z)
    fraction = np.zeros((n, n))
    seeing = [k for k in range(n) if k not in set(unusable) and len(clouds[k]) > 20]
    for i in seeing:
        T = se3.inverse(poses[i]) @ poses
        centre = T[:, :3, 3]
        for j in seeing:
            # Frames of different places never overlap.
            if i == j or np.linalg.norm(centre[j]) > APART_M / 2:
                continue
            points = se3.transform(T[j], clouds[j])
            points = points[points[:, 2] > 0.05]
            if len(points) < OVERLAP * len(clouds[j]):
                continue
            pixels = np.rint(np.nan_to_num(frames[i].camera.project(points), nan=-1)).astype(int)
            u, v = pixels.T
            height, width = images[i].shape
            inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
            z = images[i][v[inside], u[inside]]
            near = np.abs(z - points[inside, 2]) < NEAR_M
            fraction[i, j] = near.sum() / len(clouds[j])
    tied = np.minimum(fraction, fraction.T) >= OVERLAP
    _, label = connected_components(tied, directed=False)
    sizes = np.bincount(label, minlength=n)
    out = np.full(n, -1, np.intp)
    for number, group in enumerate(np.flatnonzero(sizes > 1)):
        out[label == group] = number
    return out


def as_case(
    scene: str, name: str, took: Take, *, unusable: Sequence[int] = (), seen: Take | None = None
) -> Case:
    """Make a case of a take.

    Parameters
    ----------
    unusable
        Positions of frames in which the scene is not visible, or gives no constraints.
    seen
        The undisturbed frames, if the disturbance hides the overlap.
    """
    frames = [replace(frame, index=k) for k, frame in enumerate(took.frames)]
    clear = took if seen is None else seen
    label = groups(clear.frames, took.poses, unusable)
    source = ArraySource(frames, took.poses, metadata=dict(took.metadata))
    recording = Recording.of(source, f"{scene}, {name}", "simulated")
    return Case(scene, name, recording, Truth(took.poses, label))


# ---- Disturbances of frames ----------------------------------------------------------------------


def covered(frame: RangeFrame) -> RangeFrame:
    """Cover the lens by a lid: no valid pixels."""
    amplitude = frame.amplitude_image
    return replace(
        frame,
        depth=np.zeros_like(frame.depth),
        amplitude_image=None if amplitude is None else np.zeros_like(amplitude),
    )


def hand(frame: RangeFrame, rng: np.random.Generator) -> RangeFrame:
    """Cover the lens by a hand: 6 to 14 cm away, bright, with a blurred border."""
    height, width = frame.depth.shape
    v, u = np.mgrid[:height, :width] / width
    tilt = rng.uniform(-0.04, 0.04, 2)
    depth = 0.10 + tilt[0] * u + tilt[1] * v + 0.012 * np.sin(23 * u + rng.uniform(0, 6))
    depth += rng.normal(0, 0.003, depth.shape)
    # A gap at one side, through which the scene is visible.
    gap = u > rng.uniform(0.90, 1.0)
    amplitude = frame.amplitude_image
    if amplitude is not None:
        bright = np.percentile(amplitude[amplitude > 0], 99) if (amplitude > 0).any() else 1000.0
        amplitude = np.where(gap, amplitude, 1.5 * bright + 0 * depth).astype(np.float32)
    return replace(
        frame,
        depth=np.where(gap, frame.depth, depth).astype(np.float32),
        amplitude_image=amplitude,
        sigma_image=None
        if frame.sigma_image is None
        else np.where(gap, frame.sigma_image, 0.003).astype(np.float32),
    )


def brighter(frame: RangeFrame, factor: float) -> RangeFrame:
    """Scale the amplitude, as with another integration time; depth is unchanged."""
    amplitude = frame.amplitude_image
    if amplitude is None:
        return frame
    scaled = np.minimum(factor * amplitude, SATURATED_AMPLITUDE - 1)
    scaled = np.where(amplitude >= SATURATED_AMPLITUDE, amplitude, scaled)
    return replace(frame, amplitude_image=scaled.astype(np.float32))


def farther(frame: RangeFrame, metres: float) -> RangeFrame:
    """Add an offset to the range of every valid pixel."""
    depth = frame.depth.astype(float)
    length = 1.0
    if frame.depth_kind == "z":
        xy = frame.camera.rays().astype(float)
        length = np.sqrt(1 + (np.nan_to_num(xy) ** 2).sum(-1))
    moved = np.where(depth > 0, depth + metres / length, 0)
    return replace(frame, depth=moved.astype(np.float32))


def lens_off(
    frame: RangeFrame, *, fx: float = 1.0, fy: float = 1.0, cx: float = 0.0, k1: float = 0.0
) -> RangeFrame:
    """State a lens that is wrong: factors of its focal lengths, `cx` in units of fx, distortion."""
    camera = frame.camera
    wrong = {"fx": fx * camera.fx, "fy": fy * camera.fy, "cx": camera.cx + cx * camera.fx}
    if k1:
        about = {**asdict(camera), **wrong, "k1": k1}
        return replace(frame, camera=BrownConrady(**about))
    return replace(frame, camera=replace(camera, **wrong))


def timed(frames: Sequence[RangeFrame], times: Sequence[float] | Float64) -> tuple[RangeFrame, ...]:
    """Return the frames with other timestamps."""
    return tuple(replace(frame, timestamp=float(t)) for frame, t in zip(frames, times, strict=True))


# ---- Cases ---------------------------------------------------------------------------------------


def hidden(
    base: Take, seconds: float, how: str, rng: np.random.Generator
) -> tuple[Take, list[int]]:
    """Cover the lens for a time in the middle of the recording, while the camera moves."""
    count = max(1, round(seconds / base.step_s))
    first = int(rng.integers(len(base) // 4, max(len(base) // 4 + 1, 3 * len(base) // 4 - count)))
    bad = list(range(first, min(first + count, len(base) - 1)))
    frames = tuple(
        frame if k not in bad else covered(frame) if how == "lid" else hand(frame, rng)
        for k, frame in enumerate(base.frames)
    )
    return replace(base, frames=frames), bad


def two_places(base: Take, other: Take) -> Take:
    """Continue in another place, without a gap in time."""
    half = base.at(range(len(base) // 2))
    step = base.step_s
    frames = (*half.frames, *other.frames[: len(half)])
    times = frames[0].timestamp + step * np.arange(len(frames))
    return replace(
        base,
        frames=timed(frames, times),
        poses=np.concatenate([half.poses, other.poses[: len(half)]]),
    )


def twice(base: Take, again: Take, gap_s: float = 60.0) -> Take:
    """Stop, and start again later at the initial place."""
    half = base.at(range(len(base) // 2))
    end = half.frames[-1].timestamp + gap_s
    later = end + again.step_s * np.arange(len(again))
    return replace(
        base,
        frames=(*half.frames, *timed(again.frames, later)),
        poses=np.concatenate([half.poses, again.poses]),
    )


def shuffled(base: Take, rng: np.random.Generator) -> Take:
    """Shuffle the frames, with ascending timestamps."""
    order = rng.permutation(len(base))
    times = [frame.timestamp for frame in base.frames]
    took = base.at(order)
    return replace(took, frames=timed(took.frames, times))


def cases(scene: Scene, seed: int, *, quick: bool = False, containing: str = "") -> Iterator[Case]:
    """Yield the cases of a scene.

    Parameters
    ----------
    seed
        Random seed of the scene, the camera's noise, and the disturbances.
    quick
        Skip cases that differ only in degree.
    containing
        Yield only cases whose name contains this.
    """
    durations = DURATIONS_S[1:2] if quick else DURATIONS_S
    fractions = FRACTIONS[1:2] if quick else FRACTIONS
    made: dict[str, Callable[[np.random.Generator], Case]] = {}
    cache: list[Take] = []

    def base() -> Take:
        if not cache:
            cache.append(take(scene, seed))
        return cache[0]

    def add(name: str, make: Callable[[np.random.Generator, str], Case]) -> None:
        if containing in name:
            made[name] = lambda rng: make(rng, name)

    add("as it is", lambda rng, name: as_case(scene.name, name, base()))

    def dark(rng: np.random.Generator, name: str) -> Case:
        frames = tuple(replace(f, amplitude_image=None) for f in base().frames)
        return as_case(scene.name, name, replace(base(), frames=frames))

    add("depth without amplitude", dark)
    if camera_model(scene.camera).amplitude_kind == "raw":
        add(
            "amplitude falls off to corners",
            lambda rng, name: as_case(scene.name, name, take(scene, seed, falloff=True)),
        )
    for seconds in durations:
        for how in ("lid", "hand"):

            def hide(
                rng: np.random.Generator, name: str, seconds: float = seconds, how: str = how
            ) -> Case:
                took, bad = hidden(base(), seconds, how, rng)
                return as_case(scene.name, name, took, unusable=bad)

            add(f"lens covered by a {how}, {seconds:g} s", hide)
    kinds: tuple[Kind, ...] = ("box", "person")
    for kind in kinds:
        for fraction in fractions:

            def passes(
                rng: np.random.Generator, name: str, kind: Kind = kind, fraction: float = fraction
            ) -> Case:
                took = take(scene, seed, passing=Passing(kind, fraction))
                return as_case(scene.name, name, took, seen=base())

            add(f"{kind} passes over {fraction:.0%}", passes)
    for every in (4,) if quick else (2, 4):
        add(
            f"every {every}th frame" if every > 3 else "every 2nd frame",
            lambda rng, name, every=every: as_case(
                scene.name, name, base().at(range(0, len(base()), every))
            ),
        )

    def dropped(rng: np.random.Generator, name: str) -> Case:
        kept = np.flatnonzero(rng.random(len(base())) < 0.5)
        return as_case(scene.name, name, base().at(kept))

    def amplitude(rng: np.random.Generator, name: str) -> Case:
        first = int(rng.integers(len(base()) // 3, 2 * len(base()) // 3))
        frames = [f if k < first else brighter(f, 4.0) for k, f in enumerate(base().frames)]
        return as_case(scene.name, name, replace(base(), frames=tuple(frames)))

    def warming(rng: np.random.Generator, name: str) -> Case:
        frames = tuple(farther(f, 0.001 * k) for k, f in enumerate(base().frames))
        return as_case(scene.name, name, replace(base(), frames=frames), seen=base())

    def bare(rng: np.random.Generator, name: str) -> Case:
        took = take(scene, seed, motion="close-up")
        near = np.linalg.norm(took.poses[:, :3, 3] - np.array(scene.bare[0]), axis=1) < 0.25
        return as_case(scene.name, name, took, unusable=np.flatnonzero(near).tolist())

    def places(rng: np.random.Generator, name: str) -> Case:
        # Another room of the same flat has known poses; other scenes have not.
        other = take(scene, seed, other=scene.elsewhere, frames=scene.frames // 2)
        if scene.elsewhere[0] != scene.name:
            away = other.poses.copy()
            away[:, 0, 3] += APART_M
            other = replace(other, poses=away)
        return as_case(scene.name, name, two_places(base(), other))

    def later(rng: np.random.Generator, name: str) -> Case:
        stride = round(base().step_s * 30)
        count = (scene_frames(scene.name) - scene.again) // stride
        took = take(scene, seed, other=(scene.name, scene.again), frames=count)
        return as_case(scene.name, name, twice(base(), took))

    add("half of the frames dropped", dropped)
    add("amplitude x 4 from a frame on", amplitude)
    add("warm-up, 1 mm a frame", warming)
    add(
        "quick turns",
        lambda rng, name: as_case(scene.name, name, take(scene, seed, motion="quick turns")),
    )
    add("close-up of a bare wall", bare)
    add("two places", places)
    add("the same place after a gap", later)
    add("random order", lambda rng, name: as_case(scene.name, name, shuffled(base(), rng)))
    for name, make in made.items():
        yield make(np.random.default_rng([seed, *name.encode()]))


def scene_frames(name: str) -> int:
    """Raw frames of a scene's whole sequence."""
    return simulated.SCENES[name].frames
