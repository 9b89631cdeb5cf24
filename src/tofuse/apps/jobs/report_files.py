"""The report of a result, with data from the recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tofuse.apps.results import folders
from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.errors import UnreadableFrameError
from tofuse.engine.filters import apply_filters
from tofuse.engine.frames import CloudFrame, Frame, Recording
from tofuse.engine.fusion import Textured
from tofuse.engine.geometry import se3, triangles
from tofuse.engine.mapping import Config, changed, reconstructing
from tofuse.engine.parts import name_of
from tofuse.engine.results import Reconstruction
from tofuse.engine.stopwatch import timing
from tofuse.formats.geometry import read_ply

_DRAWN_CLOUDS = 12  # views in the report, if they are clouds
_TRUTH_POINTS = 100_000
_TITLE_NAMES = 3  # of joined recordings


@timing("report")
def write_report_files(
    recording: Recording,
    config: Config,
    result: Reconstruction,
    folder: Path,
    texture: Textured | None = None,
    *,
    share: bool = False,
) -> None:
    """Write `report.html` into a folder."""
    with timing("imports"):
        from tofuse.apps.report import ReportExtras, write_report

    title = _title(recording)
    truth = truth_points(recording)
    component = folders.component_number(folder)
    if component is not None:
        title += f", component {component}"
        truth = None  # its pose relative to this component is unknown
        recording = _frames_of(recording, result)
    clouds = () if result.diagnostics.samples else recording.sample(_DRAWN_CLOUDS)
    extras = ReportExtras(
        title=title,
        filter_steps=_filter_steps(_final_config(config, result), recording, result),
        reference=reference_in_world(recording, result),
        truth_points=truth,
        clouds=tuple(item for item in clouds if isinstance(item, CloudFrame)),
        texture=texture if component is None else None,
        share=share and component is None,
    )
    write_report(result, folder / "report.html", extras)


def _frames_of(recording: Recording, result: Reconstruction) -> Recording:
    """Select the frames of a result."""
    frames = [record.index for record in result.diagnostics.frames]
    return replace(recording, indices=recording.indices[np.isin(recording.indices, frames)])


def _title(recording: Recording) -> str:
    """Return the name of a recording, or the names of those that it is joined of."""
    path = Path(recording.path)
    joined = [part["name"] for part in recording.metadata.get("parts", ())]
    joined = recording.metadata.get("cameras", joined)
    if path.exists() or not joined:
        return _name(path) or recording.path
    names = [_name(Path(name)) for name in joined[:_TITLE_NAMES]]
    more = len(joined) - len(names)
    return ", ".join(names) + (f" and {more} more" if more else "")


def _name(path: Path) -> str:
    """Return the name of a path; that of its folder for a native recording in a result."""
    name = path.stem if path.suffix.lower() == ".zip" else path.name
    return (path.parent.name if path.name == folders.RECORDING else "") or name


def _final_config(config: Config, result: Reconstruction) -> Config:
    """Return the configuration with the corrections of the result, after self-calibration.

    Self-calibration adds its corrections before the others. Those are kept as they are, as parts
    contain what they estimated from the recording, which their options don't state.
    """
    final = {"corrections": result.config["corrections"]}
    corrections = changed(config, final, where="the result's config").corrections
    added = len(corrections) - len(config.corrections)
    return replace(config, corrections=(*corrections[:added], *config.corrections))


def _filter_steps(
    config: Config, recording: Recording, result: Reconstruction
) -> tuple[tuple[str, Frame], ...]:
    """Return one frame, raw and after each filter (figure 3.2); none if it can't be read again."""
    posed = np.flatnonzero(result.has_pose)
    k = int(posed[len(posed) // 2])
    index = int(recording.indices[k])
    try:
        frame = recording[k]
        history = reconstructing.past_frames(recording, index, config.window - 1)
    except UnreadableFrameError:  # the recording has been moved or deleted
        return ()
    steps: list[tuple[str, Frame]] = [("raw", frame)]
    for correction in config.corrections:
        corrector = correction.start()
        frame = corrector.apply(frame)
        history = [corrector.apply(past) for past in history]
        steps.append((name_of(correction), frame))
    for item in (*config.filters, *config.model_filters):
        frame, removals = apply_filters([item], frame, history)
        steps.append((removals[0].name, frame))
    return tuple(steps)


def reference_in_world(recording: Recording, result: Reconstruction) -> Float64 | None:
    """Return the reference poses (N, 4, 4) in the result's world, NaN for frames without one.

    They are aligned at the first frame that has both poses.
    """
    if recording.reference is None:
        return None
    reference = se3.about(-result.shift, recording.reference)
    common = np.flatnonzero(np.isfinite(reference[:, 0, 0]) & result.has_pose)
    if len(common) == 0:
        return None
    k = common[0]
    T_world_reference = result.trajectory[k] @ se3.inverse(reference[k])
    return np.where(np.isfinite(reference), T_world_reference @ reference, np.nan)


def truth_points(recording: Recording) -> Float32 | None:
    """Return points (K, 3) on the true surfaces of a simulated recording, in its world frame."""
    path = Path(recording.path) / "truth" / "surface.ply"
    if not path.is_file():
        return None
    truth = read_ply(path)
    if truth.faces is None or len(truth.faces) == 0:
        return truth.points.astype(np.float32)
    corners = truth.points[truth.faces].astype(float)
    points = triangles.random_points(corners, _TRUTH_POINTS, np.random.default_rng(0))
    return points.astype(np.float32)
