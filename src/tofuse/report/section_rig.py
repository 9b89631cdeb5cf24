"""The rig: poses of its cameras, and distances between their overlapping surfaces."""

from __future__ import annotations

import numpy as np

from tofuse.arrays import Float64
from tofuse.geometry import se3
from tofuse.recordings.rig import RigCamera
from tofuse.report import plots, words
from tofuse.report.subject import ROWS, Subject, Values

_MAX_PAIRS = 10  # in the picture


def rig(s: Subject) -> Values:
    """Return the picture and the tables of the rig; empty for a single camera."""
    calibration = s.extras.rig
    if calibration is None:
        return {"rig_views": [], "rig_cameras": [], "rig_pairs": [], "rig_unplaced": []}
    poses = upright(np.stack([camera.T_rig_camera for camera in calibration.cameras]))
    names = [camera.name for camera in calibration.cameras]
    distances = [
        (names.index(d.a), names.index(d.b), f"{1000 * d.median_m:.1f} mm")
        for d in calibration.disagreement
    ]
    # For many cameras the table is easier to read.
    lines = distances if len(distances) <= _MAX_PAIRS else []
    views = [
        {
            "svg": plots.rig(poses, names, "above", label="The rig from above", pairs=lines),
            "caption": "From above, the first camera looks up."
            + (" Dashed lines: distance between overlapping surfaces." if lines else ""),
        },
        {
            "svg": plots.rig(poses, names, "side", label="The rig from the side"),
            "caption": "From the side, the first camera looks right.",
        },
    ]
    pairs = sorted(calibration.disagreement, key=lambda d: -d.median_m)
    return {
        "rig_views": views,
        "rig_cameras": [_camera(c, k == 0) for k, c in enumerate(calibration.cameras)],
        "rig_pairs": [
            (f"{d.a}, {d.b}", f"{1000 * d.median_m:.1f} mm", f"{d.pixels:,}") for d in pairs[:ROWS]
        ],
        "rig_unplaced": [f"{name}: {reason}" for name, reason in calibration.unplaced.items()],
    }


def upright(T_rig_camera: Float64) -> Float64:
    """Return poses (K, 4, 4) rotated so that the mean down direction of all cameras is down.

    The cameras of a ring look down from all sides: in the frame of one of them it would be tilted.
    """
    down = T_rig_camera[:, :3, 1].sum(0)
    length = float(np.linalg.norm(down))
    if length < 0.5 * len(T_rig_camera):  # they are inconsistent
        return T_rig_camera
    down = down / length
    axis = np.cross(down, [0.0, 1.0, 0.0])
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, down[1]))
    twist = np.zeros(6)
    twist[3:] = axis / max(sine, 1e-12) * angle
    return np.asarray(se3.exp(twist) @ T_rig_camera, np.float64)


def _camera(camera: RigCamera, first: bool) -> tuple[str, ...]:
    position = ", ".join(f"{x:.3f}" for x in camera.T_rig_camera[:3, 3]).replace("-", "−")
    if first:
        return (camera.name, position, "–", "–", "–", "–")
    sigma_m, sigma_rad = se3.largest_sigmas(camera.covariance).tolist()
    offsets = (camera.time_offset_s, camera.depth_offset_m)
    signed = [f"{1000 * x:+.1f}".replace("-", "−") for x in offsets]
    return (
        camera.name,
        position,
        words.length(sigma_m),
        f"{np.degrees(sigma_rad):.2g}°",
        f"{signed[0]} ms",
        f"{signed[1]} mm",
    )
