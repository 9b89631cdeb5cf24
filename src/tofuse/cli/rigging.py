"""``tofuse rig``: rigs in a few lines and tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from tofuse.geometry import se3
from tofuse.recordings.rig import Rig
from tofuse.results.output import plain
from tofuse.rigs.calibrate import Calibration, loosest
from tofuse.rigs.check import Moved


def tables(rig: Rig) -> list[Table]:
    """Where the cameras are, and how far surfaces of each two of them are apart."""
    where = Table(box=None)
    for title in ("camera", "x y z (m)"):
        where.add_column(title, no_wrap=True)
    for title in ("deg", "± mm", "± deg", "clock ms", "depth mm"):
        where.add_column(title, justify="right", no_wrap=True)
    for camera in rig.cameras:
        T = camera.T_rig_camera
        metres, radians = loosest(camera)
        values = (
            f"{np.degrees(float(se3.angle(T))):.2f}",
            f"{1000 * metres:.2g}",
            f"{np.degrees(radians):.2g}",
            f"{1000 * camera.time_offset_s:+.1f}",
            f"{1000 * camera.depth_offset_m:+.1f}",
        )
        first = camera is rig.cameras[0]
        where.add_row(
            camera.name,
            " ".join(f"{x:+.3f}" for x in T[:3, 3]),
            *(("-",) * len(values) if first else values),
        )
    pairs = Table("surfaces of", "and", "are apart (mm)", "pixels", box=None)
    for found in rig.disagreement:
        pairs.add_row(found.a, found.b, f"{1000 * found.median_m:.1f}", f"{found.pixels:,}")
    return [where, pairs] if rig.disagreement else [where]


def notes(found: Calibration) -> list[str]:
    """What a person should know, cameras without a place first."""
    unplaced = [f"{name} is not placed: {why}" for name, why in found.rig.unplaced.items()]
    return [*unplaced, *found.notes]


def exit_status(found: Calibration) -> int:
    """3 where some camera is not placed."""
    return 3 if found.rig.unplaced else 0


def check_lines(cameras: Sequence[Moved]) -> list[str]:
    """What became of each camera, one line each."""
    width = max(len(camera.name) for camera in cameras)
    return [f"{camera.name:<{width}}  {_said(camera)}" for camera in cameras]


def _said(camera: Moved) -> str:
    if camera.reason:
        return f"not checked: {camera.reason}"
    by = f"{1000 * camera.distance_m:.1f} mm and {np.degrees(camera.angle_rad):.2f} deg"
    sure = f"known to {1000 * camera.sigma_m:.1f} mm and {np.degrees(camera.sigma_rad):.2f} deg"
    if camera.moved:
        return f"moved by {by} ({sure}; by chance in {camera.chance:.1g} of the cases)"
    if camera.sigma_m == 0:
        return "as it was: the others are compared with it"
    return f"as it was, within {by} ({sure})"


def check_json(cameras: Sequence[Moved]) -> dict[str, Any]:
    """The same as plain data."""
    rows = [
        {
            "name": c.name,
            "checked": not c.reason,
            "moved": c.moved,
            "distance_m": c.distance_m,
            "angle_rad": c.angle_rad,
            "sigma_m": c.sigma_m,
            "sigma_rad": c.sigma_rad,
            "chance": c.chance,
            "reason": c.reason,
        }
        for c in cameras
    ]
    data: dict[str, Any] = plain({"cameras": rows})
    return data


def check_status(cameras: Sequence[Moved]) -> int:
    """3 where some camera was moved, or is not checked."""
    return 3 if any(camera.moved or camera.reason for camera in cameras) else 0
