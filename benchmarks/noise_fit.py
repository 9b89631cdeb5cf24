"""Noise of static recordings, measured and modelled.

    python benchmarks/noise_fit.py [folder of recordings]

Prints, for a real SR4000 (four frames at each of two positions) and a real Pico Zense (ten frames),
the temporal standard deviation of range, the model of the camera family, and the model fitted to
these frames; the same for simulated cameras, where the fit is tested on frames with independent
noise; and the gain from averaging static frames. Missing real recordings are skipped.
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from tofuse.apps.calibration.noise_estimation import NoiseFit, estimate_noise
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.noise.model import noise_model_for
from tofuse.formats.images.images import read_image
from tofuse.formats.recordings.open import open_recording
from tofuse.formats.recordings.still import average_still
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import CAMERAS, camera_model
from tofuse.lab.simulation.render import render
from tofuse.lab.world.scene import build

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
ZENSE = Pinhole(640, 480, 456.636, 456.226, 342.983, 233.82)


def main() -> None:
    data = Path(sys.argv[1]) if len(sys.argv) > 1 else DATA
    if (data / "sr4000_corridor").is_dir():
        show("SR4000, real", open_recording(data / "sr4000_corridor"))
    if (data / "pico_zense_static").is_dir():
        show("Pico Zense, real", zense(data / "pico_zense_static"))
    print("simulated cameras, a corner, 8 frames; tested on 8 other frames\n")
    print("| camera | fit: rms over bins | test frames: 5, 50, 95 % of bins, model / true |")
    print("|---|---|---|")
    for name in CAMERAS:
        simulated(name)


def show(title: str, recording: Recording) -> None:
    fit = estimate_noise(recording)
    prior = noise_model_for(recording)
    print(f"{title}: {fit.frames} frames in {fit.stretches} static segments, by {fit.law}\n")
    print("| " + fit.law + " | pixels | measured (mm) | family (mm) | fitted (mm) |")
    print("|---|---|---|---|---|")
    step = max(1, len(fit.bins) // 12)
    for k in range(0, len(fit.bins), step):
        item = fit.bins[k]
        print(
            f"| {item.low:.3g}-{item.high:.3g} | {item.pixels} | {1000 * item.measured_m:.1f} | "
            f"{1000 * family_sigma(prior, fit, k):.1f} | {1000 * item.predicted_m:.1f} |"
        )
    print(f"\nrms log error: family {fit.rms_log_error_before:.3f}, fitted {fit.rms_log_error:.3f}")
    print(f"fitted: {fit.model.to_dict()}")
    averaged = average_still(recording)
    first, mean = recording[0], averaged[0]
    assert isinstance(first, RangeFrame)
    assert isinstance(mean, RangeFrame)
    print(
        f"averaging {averaged.metadata['averaged'][0]} frames: roughness along rows "
        f"{1000 * roughness(first):.2f} -> {1000 * roughness(mean):.2f} mm\n"
    )


def family_sigma(prior: object, fit: NoiseFit, k: int) -> float:
    """Sigma of the family's model at the centre of a bin."""
    from tofuse.engine.noise.model import NoiseModel

    assert isinstance(prior, NoiseModel)
    centre = float(np.sqrt(fit.bins[k].low * fit.bins[k].high))
    if fit.law == "amplitude" and prior.amplitude is not None:
        law = prior.amplitude
        return float(np.sqrt(law.floor**2 + law.shot**2 / centre + (law.dark / centre) ** 2))
    return prior.range.a + prior.range.b * centre**2


def roughness(frame: RangeFrame) -> float:
    """Robust standard deviation of a pixel in m, from second differences along rows."""
    r, ok = frame.radial_range.astype(float), frame.valid
    second = np.abs(np.diff(r, n=2, axis=1))[ok[:, :-2] & ok[:, 1:-1] & ok[:, 2:]]
    return float(np.median(second) / 0.6745 / np.sqrt(6))


def zense(folder: Path) -> Recording:
    frames = [
        RangeFrame(
            k,
            k / 30,
            ZENSE,
            read_image(path, size=(640, 480), dtype="uint16").astype(np.float32) / 1000,
        )
        for k, path in enumerate(sorted(folder.glob("depth_*.png")))
    ]
    return Recording.of(ArraySource(frames, metadata={"sensor": "Pico Zense"}), folder, "images")


def simulated(name: str) -> None:
    scene, sequence = build("corner", seed=1)
    effects = Effects().without("multipath", "gloss", "mixed_pixels")

    def take(seed: int) -> RangeFrame:
        frame = render(scene, sequence, camera_model(name), 0, effects=effects, seed=seed).frame
        # Remove the camera's own noise, which would take precedence.
        return replace(frame, index=seed, timestamp=seed / 30, sigma_image=None)

    recording = Recording.of(ArraySource([take(k) for k in range(8)]), name, "simulated")
    fit = estimate_noise(recording, name)
    others = [take(k) for k in range(100, 108)]
    valid = np.all([f.valid for f in others], 0)
    variance = np.stack([f.radial_range for f in others]).var(0, ddof=1)
    predicted = np.mean([fit.model.sigma(f).astype(float) ** 2 for f in others], 0)
    edges = np.quantile(predicted[valid], np.linspace(0, 1, 13))
    ratios = []
    for low, high in itertools.pairwise(edges):
        inside = valid & (predicted >= low) & (predicted <= high)
        # 0.907: median of chi squared with 7 degrees of freedom, divided by 7.
        ratios.append(np.sqrt(np.median(predicted[inside] / variance[inside]) * 0.907))
    quantiles = ", ".join(f"{q:.2f}" for q in np.quantile(ratios, [0.05, 0.5, 0.95]))
    print(f"| {name} | {fit.rms_log_error:.3f} | {quantiles} |")


if __name__ == "__main__":
    main()
