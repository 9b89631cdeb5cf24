"""Are covariances consistent? Normalised errors of simulated pairs of views.

Pairs from five kinds of scene, with all camera effects and factory correction, are aligned from an
initial error of 1 cm and 0.5 degrees. Half of the sequences add a random constant motion to that of
the scene; a fifth have uniform albedo. The eigenvectors of the covariance are sorted from the best
(1) to the worst (6) constrained, in units of 1 cm and 1 degree; the error along each, divided by
its sigma, should be below 0.674, 1.645 and 1.960 in 50, 90 and 95 % of the cases. Directions
reported as unobservable, and alignments that the tracker would reject, are counted and excluded.
"plain" is the inverse of the plain information matrix.

    python benchmarks/covariance.py [--pairs 500] [--noise poisson other] [--seed 1000]

The constants were tuned on seeds 0 to 7 and 100 to 116; seeds from 1000 on are independent.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from made_once import computed_once
from tofuse.engine.alignment.projective import UNITS, ProjectiveOptions, Target, align
from tofuse.engine.alignment.uncertainty import covariance
from tofuse.engine.arrays import Float64
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.search.verification import FitStatistics
from tofuse.engine.sensor.multipath_correction import Multipath
from tofuse.engine.views.prepared_view import PreparedView, prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.simulation.record import RecordingPlan
from tofuse.lab.world.scene import build

KINDS = ("room", "empty-room", "wall", "corner", "corridor")
PAIRS = ((0, 1), (1, 2), (0, 2))
LIMITS = (0.6745, 1.6449, 1.9600)
WANTED = ((40, 60), (85, 95), (91, 98))


@dataclass(frozen=True, eq=False)
class Chain:
    """Three views of one scene, and the true camera poses."""

    frames: list[RangeFrame]
    T_room_camera: list[Float64]


def chain(kind: str, seed: int, effects: Effects, camera: str) -> Chain:
    """Simulate three views, one to six raw frames apart."""
    rng = np.random.default_rng([seed, KINDS.index(kind), 77])
    model = camera_model(camera)
    scene, sequence = build(kind, seed=seed, texture=bool(rng.random() > 0.2))
    step = int(rng.integers(1, 7))
    first = int(rng.integers(0, max(1, sequence.frames - 2 * step)))
    twist = np.zeros(6)
    if rng.random() < 0.5:
        twist = np.concatenate([rng.normal(0, 0.15, 3), rng.normal(0, np.radians(8), 3)])
    path, start = sequence.camera_path, first / sequence.frame_rate_hz
    sequence = replace(sequence, camera_path=lambda t: path(t) @ se3.exp(twist * (t - start)))
    raw = first + step * np.arange(3)
    made = RecordingPlan(scene, sequence, model, effects, seed, raw)
    poses = [sequence.T_room_camera(index / sequence.frame_rate_hz) for index in raw]
    return Chain([*made.corrected_frames()], poses)


def chains(arguments: argparse.Namespace, noise: str) -> Iterator[tuple[str, int, Chain]]:
    wanted = -(-arguments.pairs // len(PAIRS))
    for k in range(wanted):
        kind, seed = KINDS[k % len(KINDS)], arguments.seed + k // len(KINDS)
        name = f"{arguments.camera}-{noise}-{kind}-{seed}.pickle"
        kept = arguments.cache / name if arguments.cache else None
        effects = Effects(noise=noise)  # type: ignore[arg-type]
        make = partial(chain, kind, seed, effects, arguments.camera)
        yield kind, seed, computed_once(kept, make)


@dataclass(frozen=True, eq=False)
class Outcome:
    kind: str
    error: Float64
    covariances: tuple[Float64, Float64]
    unobservable: Float64


def outcome(
    kind: str, seed: int, views: list[PreparedView], poses: list[Float64], pair: tuple[int, int]
) -> Outcome | None:
    a, b = pair
    options = ProjectiveOptions()
    truth = se3.inverse(poses[a]) @ poses[b]
    rng = np.random.default_rng([seed, a, b, KINDS.index(kind)])
    perturbation = np.concatenate([rng.normal(0, 0.01, 3), rng.normal(0, np.radians(0.5), 3)])
    targets = [Target(views[a], np.eye(4))]
    aligned = align(views[b], targets, truth @ se3.exp(perturbation), options)
    if not FitStatistics().assess(aligned).is_usual:
        return None
    plain: Float64 = np.linalg.inv(aligned.information + np.diag(1e-6 / UNITS**2))
    return Outcome(
        kind,
        se3.log(se3.inverse(aligned.T_world_source) @ truth),
        (covariance(views[b], targets, aligned, options), plain),
        aligned.unobservable,
    )


def whitened(found: Outcome, C: Float64) -> Float64:
    """(6,) errors in sigmas, best to worst constrained direction; NaN: unobservable."""
    values, vectors = np.linalg.eigh(C / np.outer(UNITS, UNITS))
    out = np.abs(vectors.T @ (found.error / UNITS)) / np.sqrt(values)
    if len(found.unobservable):
        lost = ((found.unobservable @ vectors) ** 2).sum(0)
        out[lost > 0.5] = np.nan
    return out


def row(name: str, errors: Float64) -> str:
    errors = errors[np.isfinite(errors)]
    if not len(errors):
        return f"  {name:<12}      0"
    fractions = [100 * float(np.mean(errors < limit)) for limit in LIMITS]
    marks = " ".join(
        f"{fraction:5.0f}{' ' if low <= fraction <= high else '*'}"
        for fraction, (low, high) in zip(fractions, WANTED, strict=True)
    )
    return f"  {name:<12} {len(errors):6} {marks}   {np.median(errors) / LIMITS[0]:5.2f}"


def report(found: list[Outcome], which: int) -> None:
    errors = np.array([whitened(f, f.covariances[which]) for f in found])
    kinds = np.array([f.kind for f in found])
    print("               count     50     90     95   median error / expected")
    print(row("all", errors))
    for k in range(6):
        print(row(f"direction {k + 1}", errors[:, k]))
    for kind in KINDS:
        print(row(kind, errors[kinds == kind]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=500)
    parser.add_argument("--noise", nargs="+", default=["poisson", "other"])
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--camera", default="sr4000")
    parser.add_argument("--cache", type=Path, help="folder to keep the simulated views in")
    parser.add_argument("--compensate", action="store_true", help="multipath first, as by default")
    arguments = parser.parse_args()
    for noise in arguments.noise:
        found: list[Outcome] = []
        rejected = 0
        for kind, seed, made in chains(arguments, noise):
            frames = made.frames
            if arguments.compensate:
                compensation = Multipath().start()
                frames = [compensation.apply(frame) for frame in frames]  # type: ignore[misc]
            views = [prepare_view(frame, SurfaceOptions()) for frame in frames]
            for pair in PAIRS:
                got = outcome(kind, seed, views, made.T_room_camera, pair)
                if got is None:
                    rejected += 1
                else:
                    found.append(got)
        directions = sum(len(f.unobservable) for f in found)
        print(
            f"\n{arguments.camera}, noise {noise}: {len(found)} pairs, {rejected} rejected, ",
            end="",
        )
        print(f"{directions} directions unobservable; % within the 50, 90, 95 % interval")
        report(found, 0)
        print(" with the plain information matrix instead")
        report(found, 1)


if __name__ == "__main__":
    main()
