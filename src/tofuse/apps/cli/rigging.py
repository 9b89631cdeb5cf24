"""``tofuse rig``: summaries of rigs as lines and tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from tofuse.apps.results import run_json
from tofuse.apps.rigs import Calibration, CameraMotion
from tofuse.engine.geometry import se3
from tofuse.formats.rigs import Rig

# Fields of the JSON of a check.
_CHECKED = (
    *("moved", "distance_m", "angle_rad", "sigma_m", "sigma_rad"),
    *("chance", "chance_elsewhere", "reason"),
)


def tables(rig: Rig) -> list[Table]:
    """Return tables of the cameras' poses, and of the distances between overlapping surfaces."""
    poses = Table(box=None)
    for title in ("camera", "x y z (m)"):
        poses.add_column(title, no_wrap=True)
    for title in ("deg", "± mm", "± deg", "clock ms", "depth mm"):
        poses.add_column(title, justify="right", no_wrap=True)
    for camera in rig.cameras:
        T = camera.T_rig_camera
        sigma_m, sigma_rad = se3.largest_sigmas(camera.covariance).tolist()
        values = (
            f"{np.degrees(float(se3.angle(T))):.2f}",
            f"{1000 * sigma_m:.2g}",
            f"{np.degrees(sigma_rad):.2g}",
            f"{1000 * camera.time_offset_s:+.1f}",
            f"{1000 * camera.depth_offset_m:+.1f}",
        )
        first = camera is rig.cameras[0]
        poses.add_row(
            camera.name,
            " ".join(f"{x:+.3f}" for x in T[:3, 3]),
            *(("-",) * len(values) if first else values),
        )
    pairs = Table("camera", "camera", "surface distance (mm)", "pixels", box=None)
    for disagreement in rig.disagreement:
        pairs.add_row(
            disagreement.a,
            disagreement.b,
            f"{1000 * disagreement.median_m:.1f}",
            f"{disagreement.pixels:,}",
        )
    return [poses, pairs] if rig.disagreement else [poses]


def notes(calibration: Calibration) -> list[str]:
    """Return warnings, those about cameras without a pose first."""
    unplaced = [
        f"{name} has no pose: {reason}" for name, reason in calibration.rig.unplaced.items()
    ]
    return [*unplaced, *calibration.notes]


def exit_status(calibration: Calibration) -> int:
    """Return 3 if the pose of some camera is unknown, else 0."""
    return 3 if calibration.rig.unplaced else 0


def check_lines(cameras: Sequence[CameraMotion]) -> list[str]:
    """Return one line for each camera."""
    width = max(len(camera.name) for camera in cameras)
    return [f"{camera.name:<{width}}  {_outcome(camera)}" for camera in cameras]


def _outcome(camera: CameraMotion) -> str:
    if camera.reason:
        return f"not checked: {camera.reason}"
    motion = f"{1000 * camera.distance_m:.1f} mm, {np.degrees(camera.angle_rad):.2f} deg"
    sigma = f"1 sigma: {1000 * camera.sigma_m:.1f} mm, {np.degrees(camera.sigma_rad):.2f} deg"
    if camera.moved:
        p, p_elsewhere = f"{camera.chance:.1g}", f"{camera.chance_elsewhere:.1g}"
        if p_elsewhere != p:
            p += f", or {p_elsewhere} if the scene is not that of the calibration"
        return f"moved by {motion} ({sigma}; p = {p})"
    if camera.sigma_m == 0:
        return "unchanged: reference for the others"
    return f"unchanged, within {motion} ({sigma})"


def check_json(cameras: Sequence[CameraMotion]) -> dict[str, Any]:
    """Return the check as plain data."""
    rows = [
        {"name": c.name, "checked": not c.reason} | {name: getattr(c, name) for name in _CHECKED}
        for c in cameras
    ]
    data: dict[str, Any] = run_json.plain({"cameras": rows})
    return data


def check_status(cameras: Sequence[CameraMotion]) -> int:
    """Return 3 if some camera has moved or could not be checked, else 0."""
    return 3 if any(camera.moved or camera.reason for camera in cameras) else 0
