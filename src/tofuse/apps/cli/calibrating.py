"""``tofuse calibrate`` and ``tofuse noise``: the subjects of calibration, and their summaries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

from tofuse.apps.calibration import (
    Board,
    board_planes,
    calibrate_depth,
    calibrate_lens,
    check_new,
    compose,
    estimate_noise,
    fields_without_lens,
    recording_fields,
    scene_planes,
    write_camera_json,
)
from tofuse.apps.cli.commands import show, warning_lines
from tofuse.apps.cli.options import Calibrate, Noise
from tofuse.apps.cli.progress import escaped
from tofuse.engine import quantities
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.quantities import count
from tofuse.engine.sensor import DepthCorrection
from tofuse.formats.cameras import camera_file, read_correction, write_correction, write_noise
from tofuse.formats.files import atomic
from tofuse.formats.recordings import Opening, open_recording
from tofuse.formats.rigs import check_one_camera

# Data for JSON, lines to print, and warnings.
Summary = tuple[dict[str, Any], list[str], list[str]]
_MAX_LISTED = 8


_NOISE_UNITS = {"amplitude": "raw amplitude", "confidence": "confidence", "range": "range (m)"}


def calibrate(arguments: Calibrate) -> int:
    """``tofuse calibrate``."""
    if arguments.out is not None:
        check_new(arguments.out, overwrite=arguments.overwrite)
    subjects = {"lens": _lens, "depth": _depth, "import": _import_lens}
    data, lines, warnings = subjects[arguments.subject](arguments)
    return show(arguments, data, *map(escaped, lines), *warning_lines(warnings))


def noise(arguments: Noise) -> int:
    """``tofuse noise``."""
    if arguments.out is not None:
        check_new(arguments.out, overwrite=arguments.overwrite)
    fit = estimate_noise(_recording(arguments), arguments.name)
    if arguments.out is not None:
        write_noise(arguments.out, fit.model)
    table = Table(_NOISE_UNITS[fit.law], "pixels", "measured (mm)", "model (mm)", box=None)
    for item in fit.bins:
        low_high = f"{item.low:.4g} to {item.high:.4g}"
        label = f"{(item.low + item.high) / 2:.0f}" if fit.law == "confidence" else low_high
        measured, predicted = 1000 * item.measured_m, 1000 * item.predicted_m
        table.add_row(label, str(item.pixels), f"{measured:.2f}", f"{predicted:.2f}")
    return show(
        arguments,
        fit.to_dict(),
        table,
        f"{escaped(fit.model.name)}, {quantities.count(fit.frames, 'frame')} in "
        f"{count(fit.stretches, 'static segment')}: the noise model over {fit.law} deviates by "
        f"{100 * fit.rms_log_error:.0f} % rms "
        f"(built-in model: {100 * fit.rms_log_error_before:.0f} %)",
        *warning_lines(fit.warnings),
    )


def _recording(arguments: Calibrate | Noise) -> Recording:
    recording = Opening.of(arguments.inputs, arguments).open()
    check_one_camera(recording)
    return recording


def _lens(arguments: Calibrate) -> Summary:
    """``tofuse calibrate lens``."""
    board = _board(arguments)
    recording = _recording(arguments)
    fit = calibrate_lens(recording, board, arguments.model, arguments.image)
    lines = [_number(fit.camera, name, fit.sigma.get(name)) for name in fit.to_dict()["lens"]]
    lines.append(
        f"{quantities.count(len(fit.views), 'view')}, reprojection error {fit.rms_px:.3f} px rms "
        f"(with the recording's own intrinsics: {fit.rms_px_before:.3f})"
    )
    lines += [f"left out: frame {frame} {reason}" for frame, reason in fit.left_out[:_MAX_LISTED]]
    if len(fit.left_out) > _MAX_LISTED:
        lines.append(f"left out: {len(fit.left_out) - _MAX_LISTED} more frames (--json lists all)")
    if arguments.out is not None:
        write_camera_json(arguments.out, fit.camera, recording_fields(recording))
        lines.append(f"written to {arguments.out}")
    return fit.to_dict(), lines, list(fit.warnings)


def _depth(arguments: Calibrate) -> Summary:
    """``tofuse calibrate depth``."""
    recording = _recording(arguments)
    previous = _previous_correction(arguments, recording)
    if arguments.board is not None:
        board = Board.parse(arguments.board)
        views, camera = board_planes(recording, board, arguments.image, wall=arguments.wall)
    else:
        if arguments.wall:
            raise InputError("requires --board", where="--wall", remedy="pass --board as well")
        views, camera = scene_planes(recording, arguments.planes, arguments.seed or 0)
    fit = calibrate_depth(views, camera, recording.path)
    low, high = fit.range_m
    lines = [
        f"{quantities.count(fit.planes, 'plane')} in {quantities.count(fit.frames, 'frame')}, "
        f"{low:.2f} to {high:.2f} m",
        f"rms distance of pixels from the planes: {1000 * fit.before_m:.1f} mm, corrected "
        f"{1000 * fit.after_m:.1f} mm (including noise)",
        f"systematic part (means of patches): {1000 * fit.bias_before_m:.1f} mm, corrected "
        f"{1000 * fit.bias_after_m:.1f} mm",
        f"constant offset known to {1000 * fit.constant_sigma_m:.1f} mm, scale to "
        f"{100 * fit.scale_sigma:.2f} %",
    ]
    if arguments.out is not None:
        correction = fit.correction if previous is None else compose(previous, fit.correction)
        atomic.make_folder(arguments.out.parent)
        with atomic.replacing(arguments.out) as temporary:
            write_correction(temporary, correction)
        lines.append(f"written to {arguments.out}")
        if previous is not None:
            lines.append("it includes the correction that the recording already had")
    return fit.to_dict(), lines, list(fit.warnings)


def _previous_correction(arguments: Calibrate, recording: Recording) -> DepthCorrection | None:
    """Return the correction that was applied when the recording was read."""
    if not recording.metadata.get("corrected"):
        return None
    path = Path(recording.path) / "correction.npz"
    if len(arguments.inputs) != 1 or not path.is_file():
        raise InputError(
            "is already corrected, each input by its own correction",
            where=recording.path,
            remedy="pass one folder, or move its correction.npz away",
        )
    return read_correction(path)


def _import_lens(arguments: Calibrate) -> Summary:
    """``tofuse calibrate import``."""
    if len(arguments.inputs) != 1:
        raise InputError("takes one file", where="calibrate import", remedy="pass one INPUT")
    metadata: dict[str, Any] = {}
    warnings: list[str] = []
    recording = None if arguments.recording is None else open_recording(arguments.recording)
    frame = None if recording is None else recording.first_readable()
    size = (frame.camera.width, frame.camera.height) if isinstance(frame, RangeFrame) else None
    size_of_images = None if size is None else lambda: size
    lens_file = camera_file.read_lens_file(arguments.inputs[0], size_of_images)
    camera = lens_file.camera
    assert camera is not None
    own = camera.width, camera.height
    if size not in (None, own):
        warnings.append(
            f"the lens is that of images of {own[0]} x {own[1]} pixels, and those of "
            f"{arguments.recording} have {size[0]} x {size[1]}: calibrate images of that size"
        )
    if recording is not None:
        metadata = recording_fields(recording)
    elif arguments.out is not None and arguments.out.is_file():
        metadata = fields_without_lens(arguments.out)  # the unit of its recording's images
    else:
        metadata = {"depth_unit_m": lens_file.depth_unit_m, "depth_kind": lens_file.depth_kind}
        if assumption := camera_file.assumption(arguments.inputs[0]):
            warnings.append(f"{assumption}, or pass --recording to take it from a recording")
    fields = camera_file.camera_fields(camera)
    lines = [f"{name} {value}" for name, value in fields.items()]
    lines.append(f"read as a file of {lens_file.program}")
    if arguments.out is not None:
        write_camera_json(arguments.out, camera, metadata)
        lines.append(f"written to {arguments.out}")
    return {"format": lens_file.program, "warnings": warnings} | fields, lines, warnings


def _board(arguments: Calibrate) -> Board:
    if arguments.board is None:
        raise InputError(
            "is missing",
            where="--board",
            remedy="pass inner corners and square size in metres, e.g. 8x6:0.1",
        )
    return Board.parse(arguments.board)


def _number(camera: Pinhole, name: str, sigma: float | None) -> str:
    value = getattr(camera, name)
    if sigma is None:
        return f"{name} {value:.6g} (fixed)"
    digits = 2 if name in ("fx", "fy", "cx", "cy") else 5
    return f"{name} {value:.{digits}f} (sigma {sigma:.{digits}f})"
