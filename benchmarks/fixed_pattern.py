"""Depth errors that are fixed to the camera: whole runs with and without their estimate.

Recordings of the second simulator (`other_sensor.py`), without indirect light, and with errors that
are added to all depths: a smooth pattern over the image, or a periodic error of the range. Each is
reconstructed as by default, and without `refinement.fixed_pattern`. A row has the rms of these
errors, and, without and with the estimate, the rms error of the poses and the stated bound; at the
end, by rms, the median ratio of the errors, and how many are within their bound.

    python benchmarks/fixed_pattern.py [--seeds 61] [--cameras azure phone] [--rms 0 2 4]
        [--periodic 2 4]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from unittest.mock import patch

import cv2
import numpy as np

import other_sensor
from tofuse.engine.arrays import Float32
from tofuse.engine.cameras import ray_lengths
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.mapping.config import Config
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.refinement import fixed_pattern

Row = tuple[str, str, tuple[float, float], tuple[float, float]]
WIDTH = 0.1  # of the kernel that makes the pattern smooth, as a fraction of the image's width
PERIOD_M = 1.2  # of the periodic error


def pattern(shape: tuple[int, int], rms_m: float, rng: np.random.Generator) -> Float32:
    """Return a smooth random image (H, W), m."""
    width = WIDTH * shape[1]
    margin = round(3 * width)
    noise = rng.standard_normal((shape[0] + 2 * margin, shape[1] + 2 * margin))
    smooth = cv2.GaussianBlur(noise, (0, 0), width)[margin:-margin, margin:-margin]
    return (rms_m * smooth / smooth.std()).astype(np.float32)


def periodic(frame: RangeFrame, rms_m: float) -> Float32:
    """Return a periodic error of the range (H, W), as a change of the image's depth, m."""
    lengths = (
        np.ones_like(frame.depth) if frame.depth_kind == "range" else ray_lengths(frame.camera)
    )
    wave = 2**0.5 * rms_m * np.sin(2 * np.pi * frame.depth * lengths / PERIOD_M)
    return (wave / lengths).astype(np.float32)


def with_errors(recording: Recording, errors: Callable[[RangeFrame], Float32]) -> Recording:
    """Return a recording whose depth has these errors, m."""
    frames = [
        replace(
            frame, depth=np.where(frame.valid, frame.depth + errors(frame), 0).astype(np.float32)
        )
        for frame in recording
        if isinstance(frame, RangeFrame)
    ]
    source = ArraySource(frames, recording.reference, metadata=dict(recording.metadata))
    return Recording.of(source, recording.path, recording.format)


def judged(recording: Recording, config: Config | str = "default") -> tuple[float, float]:
    """Return the rms error of the poses and the stated bound, mm."""
    result = reconstruct(recording, config)
    truth, posed = recording.reference, result.has_pose
    assert truth is not None
    error = displacement(truth[posed], result.trajectory[posed])[0] if posed.sum() > 2 else np.inf
    return 1e3 * error, 1e3 * result.diagnostics.accuracy.position_m


def errors_of(
    rms: Sequence[float], along: Sequence[float], shape: tuple[int, int], seed: int
) -> Iterator[tuple[str, Callable[[RangeFrame], Float32]]]:
    """Yield errors by name, with rms over the image or along the range, mm."""
    for size in rms:
        over_image = pattern(shape, 1e-3 * size, np.random.default_rng(seed))
        yield f"{size:g}, image", lambda _, errors=over_image: errors
    for size in along:
        yield f"{size:g}, range", partial(periodic, rms_m=1e-3 * size)


def rows(
    seeds: Sequence[int], cameras: Sequence[str], rms: Sequence[float], along: Sequence[float]
) -> Iterator[Row]:
    """Yield for each recording its name, its errors, and both errors of the poses and bounds."""
    for seed in seeds:
        for camera in cameras:
            for scene in other_sensor.SCENES:
                plain = other_sensor.record(scene, camera, seed, indirect=False)
                shape = plain[0].depth.shape
                for name, errors in errors_of(rms, along, shape, seed):
                    recording = with_errors(plain, errors)
                    nothing = fixed_pattern.FixedPattern(None)
                    with patch.object(fixed_pattern, "estimate", return_value=nothing):
                        without = judged(recording)
                    yield f"{scene}, {camera}, seed {seed}", name, without, judged(recording)


def main() -> None:
    """Run all, print a row for each and the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    cameras = [*other_sensor.SENSORS]
    parser.add_argument("--seeds", nargs="*", type=int, default=[61])
    parser.add_argument("--cameras", nargs="*", default=["azure", "phone"], choices=cameras)
    parser.add_argument("--rms", nargs="*", type=float, default=[0, 2, 4], help="mm")
    parser.add_argument("--periodic", nargs="*", type=float, default=[2, 4], help="mm")
    given = parser.parse_args()
    print("| recording | errors, mm | error, mm: without, with | bound, mm |")
    print("|---" * 4 + "|")
    found = []
    for row in rows(given.seeds, given.cameras, given.rms, given.periodic):
        name, errors, without, estimated = row
        found.append(row)
        print(
            f"| {name} | {errors} | {without[0]:.1f}, {estimated[0]:.1f} "
            f"| {without[1]:.1f}, {estimated[1]:.1f} |",
            flush=True,
        )
    print("\n| errors, mm | runs | error with / without | better | within the bound |")
    print("|---" * 5 + "|")
    for errors in dict.fromkeys(row[1] for row in found):
        own = [row for row in found if row[1] == errors]
        ratios = np.array([estimated[0] / without[0] for _, _, without, estimated in own])
        inside = [sum(run[k][0] <= run[k][1] for run in own) for k in (2, 3)]
        print(
            f"| {errors} | {len(own)} | {np.median(ratios):.2f} | {(ratios < 1).sum()} "
            f"| {inside[0]}, {inside[1]} |"
        )


if __name__ == "__main__":
    main()
