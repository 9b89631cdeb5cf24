"""``tofuse rig``: rigs in a few lines and tables."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from tofuse.recordings.rig import Rig
from tofuse.rigs.calibrate import Calibration, loosest


def tables(rig: Rig) -> list[Table]:
    """Where the cameras are, and how far surfaces of each two of them are apart."""
    where = Table("camera", "x y z (m)", "turned (deg)", "known to (mm, deg)", box=None)
    where.add_column("clock (ms)", justify="right")
    where.add_column("depth (mm)", justify="right")
    for camera in rig.cameras:
        T = camera.T_rig_camera
        cosine = np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)
        metres, radians = loosest(camera)
        first = camera is rig.cameras[0]
        where.add_row(
            camera.name,
            " ".join(f"{x:+.4f}" for x in T[:3, 3]),
            f"{np.degrees(np.arccos(cosine)):.2f}",
            "-" if first else f"{1000 * metres:.2g}, {np.degrees(radians):.2g}",
            "-" if first else f"{1000 * camera.time_offset_s:+.1f}",
            "-" if first else f"{1000 * camera.depth_offset_m:+.1f}",
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
