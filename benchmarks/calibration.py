"""Lens and depth calibrated from simulated views, over cameras and seeds.

    python benchmarks/calibration.py [cameras, separated by commas [seeds]]

For each camera and seed: a checkerboard on a wall, seen from 32 viewpoints, with all errors of the
camera except multipath (a single wall has none) and drift. Prints the errors of the intrinsics, and
the residual depth errors after calibration with a board on a wall, with the board alone, and with
the wall at unknown poses. Wiggling peaks at 20 mm for the SR4000.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np

from tofuse.apps.calibration.board import Board
from tofuse.apps.calibration.depth import calibrate_depth
from tofuse.apps.calibration.lens import calibrate_lens
from tofuse.apps.calibration.plane_views import PlaneView, board_planes, scene_planes
from tofuse.engine.cameras.cameras import Camera
from tofuse.engine.errors import InputError
from tofuse.engine.frames.recording import Recording
from tofuse.lab.scenes import checkerboard
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import CameraModel, camera_model
from tofuse.lab.simulation.record import simulate_recording
from tofuse.lab.simulation.sensor import factory_correction

BOARD = Board(checkerboard.COLUMNS, checkerboard.ROWS, checkerboard.SQUARE_M)
EFFECTS = Effects(wiggling=2.6, thermal_drift=0.0).without("multipath")


def main() -> None:
    names = sys.argv[1].split(",") if len(sys.argv) > 1 else ["sr4000", "pico-flexx", "ifm-o3r"]
    seeds = int(sys.argv[2]) if len(sys.argv) > 2 else 3
    print("| camera | seed | views | f (%) | c (px) | rays (px rms) |")
    print("|---|---|---|---|---|---|")
    depths = []
    for name in names:
        model = camera_model(name)
        for seed in range(seeds):
            recording = simulate_recording(
                "checkerboard", camera=name, seed=seed, effects=EFFECTS, correction=False
            )
            print(f"| {name} | {seed} | {lens_row(recording, model)} |")
            depths.append(f"| {name} | {seed} | {depth_row(recording, model)} |")
    print("\nErrors in mm rms: curve (without its mean and slope), offsets of single pixels\n")
    print("| camera | seed | before | board on wall | board | wall |")
    print("|---|---|---|---|---|---|")
    print("\n".join(depths))


def lens_row(recording: Recording, model: CameraModel) -> str:
    true = model.camera
    try:
        fit = calibrate_lens(recording, BOARD, true.model)
    except InputError as error:
        return str(error)
    found = fit.camera
    focal = 100 * max(abs(found.fx / true.fx - 1), abs(found.fy / true.fy - 1))
    centre = max(abs(found.cx - true.cx), abs(found.cy - true.cy))
    residual = (found.rays() - true.rays()) * true.fx
    rms_px = np.sqrt(np.nanmean((residual**2).sum(-1)))
    return f"{len(fit.views)} | {focal:.3f} | {centre:.2f} | {rms_px:.2f}"


def depth_row(recording: Recording, model: CameraModel) -> str:
    ways: list[Callable[[], tuple[list[PlaneView], Camera]]] = [
        lambda: board_planes(recording, BOARD, "amplitude", wall=True),
        lambda: board_planes(recording, BOARD, "amplitude", wall=False),
        lambda: scene_planes(recording, 1, 0),
    ]
    true = factory_correction(model, EFFECTS)
    assert true.pixel_bias_m is not None
    cells, before = [], ""
    for way in ways:
        try:
            views, camera = way()
            fit = calibrate_depth(views, camera)
        except InputError as error:
            cells.append(str(error))
            continue
        r = np.linspace(*fit.range_m, 400)
        bias = np.interp(r, true.range_m, true.bias_m) + true.pixel_bias_m.mean()
        error = np.interp(r, fit.correction.range_m, fit.correction.bias_m) - bias
        bent = error - np.polyval(np.polyfit(r, error, 1), r)
        # Offsets of observed pixels; their mean belongs to the curve.
        seen = np.zeros(true.pixel_bias_m.size, bool)
        seen[np.concatenate([view.pixels for view in views])] = True
        assert fit.correction.pixel_bias_m is not None
        own = true.pixel_bias_m.ravel()[seen].astype(float)
        left = own - fit.correction.pixel_bias_m.ravel()[seen]
        before = before or f"{1000 * rms(bias):.1f}, {1000 * own.std():.1f}"
        cells.append(f"{1000 * rms(error):.2f} ({1000 * rms(bent):.2f}), {1000 * left.std():.2f}")
    return f"{before} | " + " | ".join(cells)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
