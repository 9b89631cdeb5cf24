"""The accuracy card states the accuracy of a result in one line, and possible improvements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cli_calls import refuses
from made_results import result
from tofuse.engine.quality.pose_accuracy import Accuracy, WorstFrame
from tofuse.engine.results.accuracy_card import SEPARATOR, bound, card, weakest_frame
from tofuse.engine.results.types import Reason

KNOWN = Accuracy(0.0238, 0.004, 0.0038, True, WorstFrame(17, 0.0291, 0.006))


def of(accuracy, verdict="good", reasons=()):
    made = result()
    diagnostics = replace(made.diagnostics, accuracy=accuracy, verdict=verdict, reasons=reasons)
    return replace(made, diagnostics=diagnostics)


def test_good_result() -> None:
    line = SEPARATOR.join(card(of(KNOWN)))
    assert line.startswith("±24 mm (95 %) over ")
    assert line.endswith(" · weakest: frame 17, 29 mm")
    assert "0.38 %" in line
    assert "to improve" not in line


@pytest.mark.parametrize(
    ("cause", "advice"),
    [
        ("faulty_recording", "correct the input as the inspection proposes"),
        ("calibration_alarm", "check the camera's calibration"),
    ],
)
def test_cause_precedes_its_consequences(cause, advice) -> None:
    reasons = (
        Reason("disconnected", ((0, 9),), "Parts are not connected."),
        Reason(cause, ((0, 1),), "The depth unit is wrong."),
    )
    assert card(of(KNOWN, "degraded", reasons))[-1].startswith(f"to improve: {advice}")


def test_advice_names_its_frames_unless_they_are_all() -> None:
    last = len(result().diagnostics.frames) - 1
    for ranges, ending in ((((0, 0),), "view there (frame 0)"), (((0, last),), "view there")):
        reasons = (Reason("unobserved_motion", ranges, "No structure."),)
        assert card(of(KNOWN, "degraded", reasons))[-1].endswith(ending)


def test_unbounded_and_unassessed_accuracy() -> None:
    turned = Accuracy(position_m=0.04, rotation_rad=1.08, relative=0.008, assessed=True)
    assert bound(turned, 5.0) == "±40 mm and 62° (95 %) over 5 m, 0.8 %"
    assert bound(Accuracy(), 5.0) == "accuracy not assessed"
    assert weakest_frame(Accuracy()) == ""
    loose = Accuracy(np.inf, 0.1, np.inf, True, WorstFrame(4, np.inf, 0.1), (4, 5, 6, 9))
    assert bound(loose, 5.0) == "accuracy not bounded over 5 m"
    assert bound(loose, 1790.4) == "accuracy not bounded over 1790 m"
    assert weakest_frame(loose) == "frames 4-6, 9, not bounded"


@pytest.mark.parametrize("text", ["0", "-1mm", "3 km", "mm", "nan", "inf", "1e999", "", "3mmm"])
def test_invalid_tolerance_is_refused(text, room_recording, tmp_path, capsys) -> None:
    words = ("run", room_recording, "--out", tmp_path / "out", f"--tolerance={text}")
    refuses(capsys, *words, says="is not a length, such as 30mm", prefix="tofuse run: ")
