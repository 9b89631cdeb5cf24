"""``tofuse rig``: calibration and check of rigs, with their summaries."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.table import Table

from tofuse.apps.calibration import check_new
from tofuse.apps.cli.commands import progress_unless_json, show, warning_lines
from tofuse.apps.cli.options import RigCalibrate, RigCheck
from tofuse.apps.cli.progress import escaped
from tofuse.apps.results import run_json
from tofuse.apps.rigs import Calibration, CameraMotion, calibrate, compare_in_scene
from tofuse.engine.geometry import se3
from tofuse.formats.rigs import Rig, read_rig, write_rig

# Fields of the JSON of a check.
_CHECKED = (
    *("moved", "distance_m", "angle_rad", "sigma_m", "sigma_rad"),
    *("chance", "chance_elsewhere", "reason"),
)


def _calibrated(
    arguments: RigCalibrate | RigCheck, names: Sequence[str] | None = None
) -> Calibration:
    with progress_unless_json(arguments) as progress:
        return calibrate(
            arguments.inputs,
            names=names,
            motion=arguments.motion,
            format=arguments.format,
            topic=arguments.topic,
            threads=arguments.threads,
            progress=progress,
        )


def rig_calibrate(arguments: RigCalibrate) -> int:
    """``tofuse rig calibrate``."""
    check_new(arguments.out, overwrite=arguments.overwrite)
    calibration = _calibrated(arguments)
    rig, notes = calibration.rig, calibration.notes
    write_rig(arguments.out, rig)
    return show(
        arguments,
        {**rig.to_dict(), "how": calibration.how, "notes": list(notes)},
        *_tables(rig),
        *warning_lines(f"{name} has no pose: {reason}" for name, reason in rig.unplaced.items()),
        *warning_lines(notes),
        escaped(f"from {calibration.how}; see {arguments.out}"),
        status=3 if rig.unplaced else 0,
    )


def rig_check(arguments: RigCheck) -> int:
    """``tofuse rig check``."""
    rig = read_rig(arguments.rig)
    rig.check_count(len(arguments.inputs), arguments.rig)
    calibration = _calibrated(arguments, [camera.name for camera in rig.cameras])
    cameras = compare_in_scene(rig, calibration.rig)
    rows = [
        {"name": c.name, "checked": not c.reason} | {name: getattr(c, name) for name in _CHECKED}
        for c in cameras
    ]
    width = max(len(camera.name) for camera in cameras)
    same = rig.with_same_images(calibration.rig)
    notes = list(calibration.notes)
    if same:
        notes.append(
            f"{', '.join(same)}: {arguments.rig} was made from these images, which agree with it "
            "even if the camera was moved since: record it again"
        )
    return show(
        arguments,
        run_json.plain({"cameras": rows, "images_of_calibration": same}),
        *(escaped(f"{camera.name:<{width}}  {_outcome(camera)}") for camera in cameras),
        *warning_lines(notes),
        status=3 if any(camera.moved or camera.reason for camera in cameras) else 0,
    )


def _tables(rig: Rig) -> list[Table]:
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
