"""Spoilt recordings: does a wrong pose ever look fine?

Of simulated and recorded sequences one frame, or all from one on, or all, are spoilt; the default
tracker and the checks of the whole run have to notice. A pose is wrong if it is off by more than
5 cm or 3 degrees beyond what the clean sequence drifts. It looks fine if the frame is called
tracked and held in every direction, nothing but what is said of the clean sequence too is said of
the result, and the error is beyond three times the sigma that the pose states. Where there is no
reference the clean run is it.

    python benchmarks/spoilt.py --scenes room rail torso corridor [--cases "depth"]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import sequences
from tofuse.arrays import Bool, Float64
from tofuse.geometry import se3
from tofuse.pipeline.config import from_method
from tofuse.pipeline.mapper import Mapper
from tofuse.recordings.frames import SATURATED_AMPLITUDE, RangeFrame
from tofuse.results.types import Reconstruction

Spoil = Callable[[RangeFrame], RangeFrame]

FRAMES, FIRST = 16, 7
OFF_M, OFF_RAD = 0.05, np.radians(3.0)
SIGMAS = 3.0


def arranged(order: tuple[slice, ...]) -> Spoil:
    """Spoil by putting the pixels into another order."""

    def spoil(frame: RangeFrame) -> RangeFrame:
        light = frame.amplitude_image
        return replace(
            frame,
            depth=np.ascontiguousarray(frame.depth[order]),
            amplitude_image=None if light is None else np.ascontiguousarray(light[order]),
        )

    return spoil


def scaled(factor: float) -> Spoil:
    """Spoil by another unit of depth."""
    return lambda frame: replace(frame, depth=frame.depth * np.float32(factor))


def sparse(frame: RangeFrame) -> RangeFrame:
    """Leave one pixel in a hundred."""
    return frame.keep(np.random.default_rng([1, frame.index]).random(frame.depth.shape) < 0.01)


def salted(frame: RangeFrame) -> RangeFrame:
    """Put 30 % of the pixels very near or very far."""
    rng = np.random.default_rng([2, frame.index])
    hit = rng.random(frame.depth.shape) < 0.3
    wrong = rng.choice([0.3, 8.0], frame.depth.shape)
    return replace(frame, depth=np.where(hit, wrong, frame.depth).astype(np.float32))


def constant(frame: RangeFrame) -> RangeFrame:
    """Put all pixels at one depth."""
    return replace(frame, depth=np.full_like(frame.depth, np.median(frame.depth[frame.valid])))


def covered(frame: RangeFrame) -> RangeFrame:
    """Hold a hand before the left half."""
    depth = frame.depth.copy()
    half = depth.shape[1] // 2
    v, u = np.mgrid[: depth.shape[0], :half]
    depth[:, :half] = 0.35 + 0.02 * np.sin(u / 9) + 0.03 * np.cos(v / 13)
    light = frame.amplitude_image
    if light is not None:
        light = light.copy()
        light[:, :half] = np.percentile(light, 99)
    return replace(frame, depth=depth, amplitude_image=light)


def saturated(frame: RangeFrame) -> RangeFrame:
    """Saturate the amplitude."""
    light = frame.amplitude_image
    if light is None:
        return frame
    return replace(frame, amplitude_image=np.full_like(light, SATURATED_AMPLITUDE))


SPOILT: dict[str, Spoil] = {
    "blank": scaled(0),
    "1 % valid": sparse,
    "salt and pepper": salted,
    "mirrored left to right": arranged((slice(None), slice(None, None, -1))),
    "mirrored top to bottom": arranged((slice(None, None, -1),)),
    "turned round": arranged((slice(None, None, -1), slice(None, None, -1))),
    "depth x 10": scaled(10),
    "depth / 10": scaled(0.1),
    "depth x 1.1": scaled(1.1),
    "depth x 0.9": scaled(0.9),
    "one depth": constant,
    "half covered": covered,
    "saturated": saturated,
}


def cases(frames: list[RangeFrame], other: list[RangeFrame]) -> dict[str, tuple[list, list]]:
    """Name of a case -> frames, and for each which of the clean frames it is, or None."""
    n = min(FRAMES, len(frames))
    first = min(FIRST, n // 2)
    plain = list(range(n))
    found: dict[str, tuple[list, list]] = {}
    for name, spoil in SPOILT.items():
        for how, last in (("one frame", first + 1), ("from a frame on", n)):
            bad = range(first, last)
            found[f"{name}, {how}"] = (
                [spoil(frames[k]) if k in bad else frames[k] for k in plain],
                plain,
            )
    for how, last in (("one frame", first + 1), ("from a frame on", n)):
        bad = range(first, last)
        truth = [None if k in bad else k for k in plain]
        found[f"another room, {how}"] = (
            [other[k] if k in bad else frames[k] for k in plain],
            truth,
        )
        hung = [first - 1 if k in bad else k for k in plain]
        found[f"frozen, {how}"] = ([frames[k] for k in hung], plain)
    found["frozen from the start"] = ([frames[0]] * n, [0] * n)
    for name in ("depth x 10", "depth / 10"):
        found[f"{name}, all"] = [SPOILT[name](frames[k]) for k in plain], plain
    if frames[0].amplitude_image is not None:
        amiss = [
            replace(SPOILT["mirrored left to right"](f), amplitude_image=f.amplitude_image)
            for f in frames[:n]
        ]
        found["depth mirrored, amplitude not, all"] = amiss, plain
    for far in (4, 8, 14, 32):
        path = [*range(8), *range(8 + far, 12 + far), 7, 6, 5, 4]
        if max(path) < len(frames):
            found[f"jump of {far} frames and back"] = ([frames[k] for k in path], path)
    return found


def run(frames: Sequence[RangeFrame]) -> Reconstruction | None:
    """Run the default method on frames that are corrected and filtered already."""
    config = replace(from_method("default"), corrections=(), filters=())
    mapper = Mapper(config, threads=1)
    poses = [mapper.push(replace(frame, index=k)) for k, frame in enumerate(frames)]
    return mapper.finish() if any(T is not None for T in poses) else None


def errors(result: Reconstruction, poses: Sequence[Float64 | None]) -> Float64:
    """(N, 2) m and rad; NaN without an estimate, infinite where there is no true pose."""
    out = np.full((len(poses), 2), np.nan)
    for k, true in enumerate(poses):
        if result.has_pose[k]:
            out[k] = np.inf
            if true is not None:
                off = se3.inverse(true) @ result.trajectory[k]
                out[k] = np.linalg.norm(off[:3, 3]), float(se3.angle(off))
    return out


def admitted(result: Reconstruction, off: Float64) -> Bool:
    """(N,) whether errors (N, 2), m and rad, are such as the frames themselves allow for."""
    out = np.array([len(frame.unobservable) > 0 for frame in result.diagnostics.frames])
    for k, frame in enumerate(result.diagnostics.frames):
        if not out[k] and frame.covariance is not None:
            parts = frame.covariance[:3, :3], frame.covariance[3:, 3:]
            sigma = np.sqrt([np.linalg.eigvalsh(part)[-1] for part in parts])
            out[k] = bool((off[k] <= SIGMAS * sigma).all())
    return out


def main() -> None:
    """Print a row for each case in which a pose is wrong, and the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--scenes", nargs="+", type=sequences.check, default=["room", "rail", "torso"]
    )
    parser.add_argument("--cases", default="", help="only those whose name contains this")
    parser.add_argument("--data", type=Path, default=sequences.DATA)
    options = parser.parse_args()
    # Not the same room with chairs in it.
    others = {"room": "rail", "torso": "box", "box": "torso", "iphone": "kitchen"}
    others |= {"empty-room": "rail", "empty-room-uniform": "rail"}
    print(f"{'scene':12} {'amplitude':9} {'case':40} wrong  marked  reasons")
    counts = np.zeros(3, int)
    for scene in options.scenes:
        sequence = sequences.load(scene, options.data, 48)
        foreign = sequences.load(others.get(scene, "room"), options.data, FRAMES)
        for lit in (True, False):
            frames, other = (
                [f if lit else replace(f, amplitude_image=None, color_image=None) for f in s.frames]
                for s in (sequence, foreign)
            )
            clean = run(frames)
            assert clean is not None
            reference = se3.inverse(sequence.reference[0]) @ sequence.reference
            if not np.isfinite(reference).all():
                reference = clean.trajectory
            drift = np.nanmax(errors(clean, list(reference[: len(frames)])), axis=0)
            said = {reason.code for reason in clean.diagnostics.reasons}
            for name, (spoilt, path) in cases(frames, other).items():
                if options.cases not in name:
                    continue
                counts[0] += 1
                result = run(spoilt)
                if result is None:
                    continue
                off = errors(result, [None if k is None else reference[k] for k in path])
                tracked = [f.status == "tracked" for f in result.diagnostics.frames]
                wrong = (off > drift + np.array([OFF_M, OFF_RAD])).any(1) & tracked
                if not wrong.any():
                    continue
                new = {reason.code for reason in result.diagnostics.reasons} - said
                marked = bool(new) or not (wrong & ~admitted(result, off)).any()
                counts[1] += 1
                counts[2] += not marked
                word = "yes" if marked else "NO"
                row = f"{scene:12} {lit!s:9} {name:40} {wrong.sum():5}  {word:6}"
                print(row, " ".join(sorted(new)), flush=True)
    print(f"{counts[0]} cases, {counts[1]} with a wrong pose, {counts[2]} of them look fine")


if __name__ == "__main__":
    main()
