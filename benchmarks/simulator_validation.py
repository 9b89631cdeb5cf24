"""Simulated cameras compared with real ones: noise by confidence and amplitude, edge profiles.

    python benchmarks/simulator_validation.py [folder of the real recordings]

Prints the tables of docs/simulator.md and writes figures to benchmarks/out/. The real cameras were
static, so the simulated ones are too. The scenes differ, so that relations are compared (noise at a
given confidence or amplitude, the profile across an edge), not images.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np

from tofuse.engine.frames.frames import RangeFrame
from tofuse.formats.images.images import read_image
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.simulation import sensor
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import CAMERAS, camera_model
from tofuse.lab.simulation.record import corrected
from tofuse.lab.simulation.render import render
from tofuse.lab.world import scene as scenes

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
OUT = Path(__file__).resolve().parent / "out"
SR4000 = camera_model("sr4000")

Positions = Sequence[Sequence[RangeFrame]]


def still(
    scene: str, raw: Sequence[int], frames: int, camera: str, effects: Effects | None = None
) -> list[list[RangeFrame]]:
    """Frames of a static camera at the poses of raw frames of a scene."""
    effects = effects or Effects()
    built, moving = scenes.build(scene)
    model = camera_model(camera)
    correction = sensor.factory_correction(model, effects)
    out = []
    for k in raw:
        t = k / moving.frame_rate_hz
        T_room_camera, T_room_object = moving.T_room_camera(t), moving.T_room_object(t)
        fixed = scenes.Sequence(
            frames,
            1,
            moving.frame_rate_hz,
            lambda _t, T=T_room_camera: T,
            None if T_room_object is None else lambda _t, T=T_room_object: T,
        )
        taken = []
        for i in range(frames):
            frame = render(built, fixed, model, i, effects=effects, seed=int(k)).frame
            taken.append(corrected(frame, correction))
        out.append(taken)
    return out


def temporal(frames: Sequence[RangeFrame]) -> tuple[np.ndarray, ...]:
    """Standard deviation of z, mean range, raw amplitude and median confidence (H, W)."""
    z = np.stack([f.z for f in frames]).astype(float)
    r = np.stack([f.radial_range for f in frames]).astype(float)
    rays = frames[0].camera.rays().astype(float)
    falloff = (1 + (rays**2).sum(-1)) ** (-SR4000.falloff / 2)
    compensated = np.stack([f.amplitude_image for f in frames]).astype(float)
    raw = compensated / np.maximum(r, 0.05) ** 2 * falloff
    raw[compensated >= 65535] = np.nan
    confidence = np.stack([f.confidence_image for f in frames])
    return z.std(0, ddof=1), r.mean(0), raw.mean(0), np.median(confidence, 0)


def noise_by(
    positions: Positions, pick: Callable[..., np.ndarray], edges: Sequence[float]
) -> list[tuple[float, int]]:
    """Median temporal deviation of z in mm and number of pixels, for each bin of a quantity."""
    deviation, quantity = [], []
    for frames in positions:
        std, r, raw, confidence = temporal(frames)
        deviation.append(std.ravel())
        quantity.append(pick(r, raw, confidence).ravel())
    std, q = np.concatenate(deviation), np.concatenate(quantity)
    out = []
    for low, high in itertools.pairwise(edges):
        chosen = std[(q >= low) & (q < high)]
        out.append((1e3 * float(np.median(chosen)) if len(chosen) > 20 else np.nan, len(chosen)))
    return out


def print_noise(real: Positions, simulated: Positions) -> dict[str, tuple]:
    print("SR4000: temporal standard deviation of z, 4 static frames at a time, median (mm)")
    kept = {}
    for name, pick, edges in (
        ("confidence", lambda _r, _a, c: c, [*np.arange(8) - 0.01, 7.5]),
        ("raw amplitude", lambda _r, a, _c: a, [10, 20, 30, 45, 65, 90, 130, 180, 260, 400]),
    ):
        one, two = noise_by(real, pick, edges), noise_by(simulated, pick, edges)
        kept[name] = (edges, one, two)
        print(f"  {name:>15s} {'real':>8s} {'simulated':>10s} {'ratio':>7s} {'pixels':>15s}")
        for low, high, (a, n), (b, m) in zip(edges, edges[1:], one, two, strict=False):
            label = f"{low:.0f}" if name == "confidence" else f"{low:.0f} to {high:.0f}"
            print(f"  {label:>15s} {a:8.1f} {b:10.1f} {b / a:7.2f} {n:7d} {m:7d}")
    return kept


def agreement_of_confidence(real: Positions) -> None:
    """Print how often the simulator's rule reproduces the confidence of the real camera."""
    same = near = total = 0
    for frames in real:
        transmission = SR4000.transmission
        for f in frames:
            r = np.maximum(f.radial_range.astype(float), 0.05)
            raw = f.amplitude_image / r**2 * transmission
            level = np.searchsorted(SR4000.confidence_thresholds, raw, side="right")
            error = np.abs(level - f.confidence_image.astype(int))[f.valid]
            same, near, total = (
                same + (error == 0).sum(),
                near + (error <= 1).sum(),
                total + error.size,
            )
    print(
        f"confidence by the simulator's rule on the real amplitudes: same {same / total:.3f}, "
        f"within one step {near / total:.3f} of {total} pixels"
    )


def edge_profiles(
    positions: Positions, *, step: float = 0.3, limit: float = 2.0
) -> tuple[np.ndarray, int]:
    """Relative positions of pixels at depth steps between the two sides: 0 near, 1 far.

    At a step, the three pixels on either side of a pixel are smooth (within 4 cm and 2 %), and the
    sides differ by `step` to `limit` m; adjacent candidates count once, at their centre. Returns
    the positions (steps, 3) of the pixel and its two neighbours, near side first.
    """
    found = []
    for frames in positions:
        z = np.stack([f.z for f in frames]).astype(float)
        good = (z > 0).all(0)
        z = z.mean(0)
        for rows, ok in ((z, good), (z.T, good.T)):
            left = np.stack([rows[:, 0 + k : rows.shape[1] - 8 + k] for k in range(3)])
            right = np.stack([rows[:, 6 + k : rows.shape[1] - 2 + k] for k in range(3)])
            centre = np.stack([rows[:, 3 + k : rows.shape[1] - 5 + k] for k in range(3)])
            fine = np.stack([ok[:, k : ok.shape[1] - 8 + k] for k in range(9)]).all(0)
            a, b = np.median(left, 0), np.median(right, 0)
            even = np.minimum(a, b) * 0.02 + 0.04
            jump = np.abs(b - a)
            take = fine & (np.ptp(left, axis=0) < even) & (np.ptp(right, axis=0) < even)
            take &= (jump > step) & (jump < limit)
            place = (centre - a) / np.where(jump > 0, b - a, 1)
            place = np.where(b > a, place, (1 - place)[::-1])
            # Of adjacent candidates, the one whose pixel lies closest to halfway.
            for row, mask in zip(np.moveaxis(place, 0, -1), take, strict=True):
                starts = np.flatnonzero(np.diff(np.r_[0, mask.astype(int), 0]) == 1)
                ends = np.flatnonzero(np.diff(np.r_[0, mask.astype(int), 0]) == -1)
                for s, e in zip(starts, ends, strict=True):
                    found.append(row[s + np.abs(row[s:e, 1] - 0.5).argmin()])
    return np.array(found).reshape(-1, 3), len(found)


BINS = np.array([-np.inf, -0.1, 0.1, 0.3, 0.5, 0.7, 0.9, 1.1, np.inf])


def print_edges(cases: dict[str, Positions]) -> dict[str, np.ndarray]:
    print("depth steps of 0.3 to 2 m: pixels between the two sides (0.1 to 0.9 of the step)")
    print(
        f"  {'':26s} {'steps':>6s} {'per step':>9s} {'outside':>8s}"
        "   fraction of those between, by position"
    )
    print(f"  {'':52s}   0.1-0.3 0.3-0.5 0.5-0.7 0.7-0.9")
    out = {}
    for name, positions in cases.items():
        place, count = edge_profiles(positions)
        fraction = np.histogram(place, BINS)[0] / max(count, 1)
        between = fraction[2:6]
        parts = " ".join(f"{p:7.2f}" for p in between / max(between.sum(), 1e-9))
        outside = fraction[0] + fraction[-1]
        print(f"  {name:26s} {count:6d} {between.sum():9.2f} {outside:8.2f}   {parts}")
        out[name] = fraction
    return out


def print_zense(folder: Path) -> None:
    """Print the noise over range of the real Pico Zense and of the simulated pico-flexx."""
    depth = [read_image(p) * 1e-3 for p in sorted(folder.glob("depth_*.png"))]
    z = np.stack(depth).astype(float)
    still_frames = still("rail", [0, 150], 10, "pico-flexx")
    simulated = [np.stack([f.z for f in frames]).astype(float) for frames in still_frames]
    print("Pico Zense (real) and pico-flexx (simulated): temporal deviation of z, 10 frames (mm)")
    print(
        f"  {'':12s} {'5 %':>7s} {'50 %':>7s} {'95 %':>7s}"
        "   median at 0.5-1, 1-1.5, 1.5-2.5, 2.5-4 m"
    )
    for name, stacks in (("real", [z]), ("simulated", simulated)):
        std, mean = [], []
        for s in stacks:
            ok = (s > 0.1).all(0)
            std.append(s.std(0, ddof=1)[ok])
            mean.append(s.mean(0)[ok])
        d, m = 1e3 * np.concatenate(std), np.concatenate(mean)
        quantiles = " ".join(f"{q:7.1f}" for q in np.percentile(d, [5, 50, 95]))
        bins = [
            f"{np.median(d[(m >= a) & (m < b)]):.1f}" if ((m >= a) & (m < b)).sum() > 50 else "-"
            for a, b in ((0.5, 1), (1, 1.5), (1.5, 2.5), (2.5, 4))
        ]
        print(f"  {name:12s} {quantiles}   {', '.join(bins)}")


def print_correction() -> None:
    print(
        "residual of the factory correction on a wall, without noise, scattering and multipath (mm)"
    )
    effects = Effects().without(
        "shot_noise",
        "scatter",
        "multipath",
        "thermal_drift",
        "smear",
        "saturation",
        "under_exposure",
    )
    built, sequence = scenes.build("wall")
    for name in CAMERAS:
        model = camera_model(name)
        correction = sensor.factory_correction(model, effects)
        rendered = render(built, sequence, model, 20, effects=effects)
        frame = rendered.frame
        depth = corrected(frame, correction).depth
        clean = (rendered.flags == 0) & (frame.depth > 0)
        rms = [
            1e3 * np.sqrt(((d - rendered.depth)[clean].astype(float) ** 2).mean())
            for d in (frame.depth, depth)
        ]
        print(f"  {name:12s} raw {rms[0]:6.2f}   corrected {rms[1]:5.2f}")


def print_timing() -> None:
    print("time per frame of `room`, all effects, warm (s; this machine, all its threads)")
    built, sequence = scenes.build("room")
    for name in CAMERAS:
        model = camera_model(name)
        render(built, sequence, model, 0)
        start = perf_counter()
        for k in range(3):
            render(built, sequence, model, 3 * k)
        print(f"  {name:12s} {(perf_counter() - start) / 3:6.2f}")


def draw(noise: dict[str, tuple], profiles: dict[str, np.ndarray]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    OUT.mkdir(exist_ok=True)
    figure, axes = plt.subplots(1, 2, figsize=(11, 4))
    for axis, (name, (edges, one, two)) in zip(axes, noise.items(), strict=True):
        x = np.arange(8) if name == "confidence" else np.sqrt(np.multiply(edges[:-1], edges[1:]))
        axis.plot(x, [a for a, _ in one], "o-", label="real SR4000")
        axis.plot(x, [b for b, _ in two], "s--", label="simulated")
        axis.set(xlabel=name, ylabel="temporal deviation of z (mm)", yscale="log")
        if name != "confidence":
            axis.set_xscale("log")
        axis.legend()
    figure.tight_layout()
    figure.savefig(OUT / "simulator_noise.png", dpi=100)
    figure, axis = plt.subplots(figsize=(7, 4))
    for name, fraction in profiles.items():
        axis.plot([0.2, 0.4, 0.6, 0.8], fraction[2:6], "o-", label=name)
    axis.set(xlabel="position between near (0) and far (1) side", ylabel="pixels per step")
    axis.legend()
    figure.tight_layout()
    figure.savefig(OUT / "simulator_edges.png", dpi=100)


def main(data: Path) -> int:
    print_correction()
    print_timing()
    corridor = data / "sr4000_corridor"
    if not corridor.is_dir():
        print(f"{data}: no real recordings found", file=sys.stderr)
        return 2
    real = [list(open_recording(corridor / y)) for y in ("Y1", "Y2")]
    simulated = still("corridor", [0, 30], 4, "sr4000")
    simulated += still("room", [0, 120, 280], 4, "sr4000")
    noise = print_noise(real, simulated)
    agreement_of_confidence(real)
    print_zense(data / "pico_zense_static")
    kinect = [[f] for f in open_recording(data / "kinectv2_loop" / "recording")]
    profiles = print_edges(
        {
            "SR4000, real": real,
            "sr4000, simulated": simulated[2:] + still("rail", [0, 150], 4, "sr4000"),
            "Kinect v2, real": kinect,
            "kinect2, simulated": still("rail", [0], 1, "kinect2")
            + still("room", [0, 120], 1, "kinect2"),
        }
    )
    draw(noise, profiles)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else DATA))
