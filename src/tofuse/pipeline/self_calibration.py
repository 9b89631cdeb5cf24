"""Self-calibration: a recording that shows an error of its camera is reconstructed without it.

Refined views say if a focal length or a depth offset bends the path: with that corrected they
support each other better, and a loop closes that neighbours alone miss
(`posegraph.calibration_check`). The
recording is then reconstructed once more with it corrected, and this stays only where the stated
bound of the poses gets smaller (`posegraph.accuracy`). Where neither trajectory is bounded, views
must fit better before they are refined.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tofuse.corrections.camera_errors import CameraErrors
from tofuse.pipeline.config import Config
from tofuse.pipeline.progress import Progress
from tofuse.posegraph.calibration_check import CalibrationCheck
from tofuse.posegraph.calibration_check import in_words as errors_in_words
from tofuse.results.card import length
from tofuse.results.types import Diagnostics, Reason, Reconstruction, SelfCalibration
from tofuse.results.verdict import ranked

# The first estimate is made with poses that the error has bent, the second one is not.
_ROUNDS = 2
# Options of `CameraErrors` by the names of the errors.
_FIELDS = {"focal": "focal", "offset": "offset_m"}

Once = Callable[[Config], Reconstruction]


def self_calibrated(
    first: Reconstruction, config: Config, once: Once, progress: Progress
) -> Reconstruction:
    """Reconstruct anew, without the errors of the camera that the views show.

    Parameters
    ----------
    first
        What there is without a correction.
    once
        Reconstructs the recording by a configuration.
    """
    best, corrected = first, CameraErrors()
    for _ in range(_ROUNDS):
        shown = _shown(best)
        if shown is None:
            break
        suspicion, error = shown
        wrong = corrected.and_then(error)
        progress.note(f"views agree better with {in_words(wrong)}: reconstructing again with it")
        again = once(replace(config, corrections=(wrong, *config.corrections)))
        if not _is_better(again, best):
            progress.note("views do not agree better for it: left as it was")
            break
        said = SelfCalibration(
            wrong.focal,
            wrong.offset_m,
            {_FIELDS[suspicion.best]: suspicion.sigmas[suspicion.best]},
            (_bound(first), _bound(again)),
        )
        best, corrected = replace(again, diagnostics=_told(again, said)), wrong
    return best


def in_words(wrong: CameraErrors) -> str:
    """What is corrected: "a focal length 4.5 % smaller"."""
    errors = {name: getattr(wrong, field) for name, field in _FIELDS.items()}
    return " and ".join(errors_in_words({name: e for name, e in errors.items() if e}))


def _shown(result: Reconstruction) -> tuple[CalibrationCheck, CameraErrors] | None:
    """The error that the views of a result show, if they do; of several the one that helps most."""
    refinement = result.diagnostics.refinement
    found = None if refinement is None else refinement.calibration_check
    if found is None or not found.alarm:
        return None
    value = found.errors[found.best]
    try:
        return found, CameraErrors(**{_FIELDS[found.best]: value})
    except ValueError:
        return None  # no camera is so far off


def _is_better(again: Reconstruction, before: Reconstruction) -> bool:
    """Whether as many frames have a pose, and show a smaller error."""
    if again.has_pose.sum() < before.has_pose.sum():
        return False
    new, old = _bound(again), _bound(before)
    # Where something is not bounded whatever the calibration, the views decide.
    return new < old if np.isfinite([new, old]).any() else _support(again) > _support(before)


def _bound(result: Reconstruction) -> float:
    return result.diagnostics.accuracy.position_m


def _gain(before: float, after: float) -> str:
    """What became of the bound, in words."""
    if not np.isfinite([before, after]).all():
        return ""
    return f" The poses are off by up to {length(after)} (95 % bound) instead of {length(before)}."


def _support(result: Reconstruction) -> float:
    """Of the views for each other, before the refinement takes up what is wrong."""
    refinement = result.diagnostics.refinement
    return refinement.support[0] if refinement is not None else 0.0


def _told(result: Reconstruction, said: SelfCalibration) -> Diagnostics:
    """The diagnostics, with what was corrected."""
    d = result.diagnostics
    indices = [f.index for f in d.frames]
    wrong = CameraErrors(said.focal, said.offset_m)
    text = (
        f"The calibration of the camera was corrected: views agree with {in_words(wrong)} "
        f"than stated.{_gain(*said.bound_m)}"
    )
    reason = Reason("self_calibrated", ((indices[0], indices[-1]),), text)
    return replace(d, calibrated=said, reasons=ranked([*d.reasons, reason]))
