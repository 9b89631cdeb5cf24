"""The verdict: each reason comes from its own evidence, and none from good evidence."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from tofuse.engine.alignment.base import Registration
from tofuse.engine.geometry import se3
from tofuse.engine.graph.external_sensors import SensorRecord
from tofuse.engine.graph.graph import GraphPart, LoopRecord, Measured, Optimisation, build_graph
from tofuse.engine.graph.graph_covariances import GraphCovariances
from tofuse.engine.quality.cross_view_agreement import CrossViewConsistency, PairConsistency
from tofuse.engine.quality.pose_accuracy import Accuracy, ObservedErrors, accuracy_of
from tofuse.engine.refinement.calibration_check import CalibrationCheck
from tofuse.engine.refinement.loop_drift import Gap
from tofuse.engine.refinement.range_change import RangeChange
from tofuse.engine.refinement.refinement import Refinement
from tofuse.engine.results import checks
from tofuse.engine.results.checks import Evidence, judge
from tofuse.engine.results.types import Component, FrameRecord, Reason
from tofuse.engine.results.verdicts import REASONS, ranked, verdict_of

STEP = se3.exp(np.array([0.05, 0, 0, 0, 0.02, 0]))


def registration(share=0.5, converged=True, unheld=False) -> Registration:
    free = np.eye(6)[: int(unheld)]
    found = int(1000 * share)
    return Registration(STEP, converged, 10, found, 1000, 0.3, 0.01, np.eye(6) * 1e4, free)


def pair(i, j, share=0.95, rms=0.004, compared=10_000) -> PairConsistency:
    seen = share * compared
    return PairConsistency(i, j, seen, compared - seen, seen * rms**2)


def seen(far_share=0.95, far_rms=0.004, near_share=0.95, near_rms=0.004) -> CrossViewConsistency:
    near = [pair(k, k + 1, near_share, near_rms) for k in range(8)]
    far = [pair(i, j, far_share, far_rms) for i in range(9) for j in range(i + 2, 9)]
    return CrossViewConsistency(tuple(range(9)), tuple(near + far))


def closing(poses, ends, rows, gap=(0.0,) * 6, information=None) -> Measured:
    """A measured motion between two poses, off by a 6-vector."""
    T = se3.inverse(poses[rows[0]]) @ poses[rows[1]] @ se3.exp(-np.asarray(gap, float))
    return Measured(*ends, T, np.eye(6) if information is None else information)


def evidence(
    statuses=("tracked",) * 9,
    *,
    shares=None,
    converged=None,
    gaps=((0, 8, [0.0] * 6),),
    rejected=(),
    given=(),
    settled=True,
    images=None,
    unheld=(),
    steps=None,
    sigma=None,
    parts=(),
    **more,
) -> Evidence:
    """Evidence of nine frames of a trajectory, closed by loops (i, j, 6-vector of the chain error).

    `sigma` is the standard deviation of each registration and loop, m and rad, if known.
    """
    n = len(statuses)
    records = tuple(FrameRecord(k, 0.1 * k, s) for k, s in enumerate(statuses))
    posed = [k for k, s in enumerate(statuses) if s in ("tracked", "predicted")]
    poses = np.stack([np.linalg.matrix_power(STEP, k) for k in posed])
    if steps is not None:
        poses = np.stack([se3.exp(np.asarray(xi, float)) for xi in steps])
    shares = shares or [0.5] * n
    converged = converged or [True] * n
    registrations = tuple(
        registration(shares[k], converged[k], k in unheld) if k in posed[1:] else None
        for k in range(n)
    )
    information = np.eye(6) if sigma is None else np.diag(np.repeat(sigma, 3) ** -2.0)
    sequence = [Measured(a, b, STEP, information) for a, b in pairwise(posed)]
    row = {frame: k for k, frame in enumerate(posed)}
    closed = [
        closing(poses, (i, j), (row[i], row[j]), gap, information)
        for i, j, gap in gaps
        if i in row and j in row
    ]
    graph = build_graph(posed, poses, sequence, closed)
    loops = [LoopRecord(i, j, True, "") for i, j, _ in gaps]
    loops += [LoopRecord(i, j, False, "only 3 % of the points correspond") for i, j in rejected]
    known = sigma is not None
    accuracy = accuracy_of(GraphCovariances(graph), ObservedErrors(), 1.0) if known else Accuracy()
    optimised = Optimisation(graph, (1.0, 0.5), settled, parts=parts)
    images = seen() if images is None else images
    found = (records, registrations, tuple(loops), poses, optimised, images, accuracy)
    more |= {"diagonal_m": 1.0, "has_covariances": known, "given_loops": frozenset(given)}
    return Evidence(*found, **more)


def codes(e: Evidence) -> list[str]:
    return [reason.code for reason in judge(e)[1]]


def test_good_evidence_gives_no_reason() -> None:
    assert judge(evidence()) == ("good", ())
    predicted = evidence(("tracked",) * 4 + ("predicted",) + ("tracked",) * 4)
    assert judge(predicted) == ("good", ())


def apart(*ranges) -> Component:
    return Component(ranges, None, None)


def in_components(*others, frames=9, lost=()) -> Evidence:
    """Evidence of frames of which some are in other components; connected ones have poses."""
    number = {
        k: c
        for c, other in enumerate(others, 1)
        for first, last in other.frames
        for k in range(first, last + 1)
    }
    main = [k for k in range(frames) if k not in number and k not in lost]
    runs = np.split(main, np.flatnonzero(np.diff(main) > 1) + 1)
    first = Component(tuple((int(r[0]), int(r[-1])) for r in runs), np.eye(4), None)
    e = evidence(
        ("tracked",) * frames,
        gaps=((0, main[-1], [0.0] * 6),) if main[-1] else (),
        images=CrossViewConsistency((), ()),
        components=(first, *others),
    )
    records = list(e.records)
    for k, record in enumerate(records):
        where = {"status": "lost"} if k in lost else {"component": number.get(k, 0)}
        records[k] = replace(record, **where)
    posed = [k for k in range(frames) if k not in lost]
    kept = [k for k in posed if k in main or others[number[k] - 1].connected]
    steps = [Measured(a, b, STEP, np.eye(6)) for a, b in pairwise(kept) if b == a + 1]
    ends = (kept[0], kept[-1])
    closed = [closing(e.sequential, ends, ends)] if len(kept) > 1 else []
    graph = build_graph(kept, e.sequential[kept], steps, closed)
    optimisation = replace(e.optimisation, graph=graph)
    changes = {"sequential": e.sequential[kept], "optimisation": optimisation}
    return replace(e, records=tuple(records), **changes)


UNDETERMINED = CalibrationCheck(motion={"focal": (3.0, 0.2)})
RANGE_CHANGES = replace(UNDETERMINED, range_change=RangeChange(0.05, 0.001, 4, 5.0))


def refined_with(check: CalibrationCheck) -> Refinement:
    return Refinement(np.zeros((9, 4, 4)), True, 9, 20, calibration_check=check)


CASES = {
    "few_poses": evidence(("tracked",) + ("lost",) * 7 + ("tracked",)),
    "images_disagree": evidence(images=seen(0.2, near_share=0.9)),
    "lost_frames": evidence(("tracked",) * 4 + ("lost",) * 2 + ("tracked",) * 3),
    "images_differ": evidence(images=seen(0.75)),
    "weak_registration": evidence(shares=[0.5] * 4 + [0.04] + [0.5] * 4),
    "not_converged": evidence(converged=[True] * 4 + [False] + [True] * 4),
    "unchecked_drift": evidence(gaps=()),
    "uncertain_poses": evidence(gaps=(), sigma=(0.02, 0.001)),
    "calibration_alarm": evidence(gaps=((0, 8, [0.05, 0, 0, 0, 0, 0]),), sigma=(0.001, 0.001)),
    "unchecked_calibration": evidence(
        gaps=(), sigma=(0.001, 0.001), refinement=refined_with(UNDETERMINED)
    ),
    "not_improved": evidence(parts=(GraphPart(0, 9, 9, 1.0, 1.0, True),)),
    "not_refined": evidence(refinement=Refinement(np.zeros((9, 4, 4)), views=9, pairs=20)),
    "loop_gap": evidence(gaps=((0, 8, [0.2, 0, 0, 0, 0, 0]),)),
    "optimiser_gave_up": evidence(settled=False),
    "unreadable_frames": evidence(("tracked",) * 4 + ("skipped",) + ("tracked",) * 4),
    "jumped": evidence(steps=[(0.05 * k + 0.4 * (k > 4), 0, 0, 0, 0, 0) for k in range(9)]),
    "unobserved_motion": evidence(unheld=(4,)),
    "bounded_by_odometry": replace(
        evidence(sigma=(0.0001, 0.0001)),
        accuracy=Accuracy(0.001, 0.001, 0.001, True, by_odometry=(4, 5)),
    ),
    "bounded_by_motion": replace(
        evidence(sigma=(0.0001, 0.0001)),
        accuracy=Accuracy(0.001, 0.001, 0.001, True, by_motion=(4, 5)),
    ),
    "repeated_images": evidence(repeated=(4, 5)),
    "implausible_depth": evidence(depths=(25.0,) * 9),
    "stood_still": evidence(steps=[(0.001 * (k % 2), 0, 0, 0, 0, 0) for k in range(9)]),
    "single_frame": evidence(("tracked",)),
    "sensor_differs": replace(
        evidence(), priors=(SensorRecord("odometry", 8, 0, None, "it was not used"),)
    ),
    "loop_rejected": evidence(rejected=[(1, 7)], given=[(1, 7)]),
    "disconnected": in_components(apart((7, 8))),
    "bridged_gap": in_components(Component(((5, 8),), np.eye(4), "motion")),
    "single_link": replace(evidence(), single_link_frames=(5, 6, 7, 8)),
    "moving_objects": evidence(moving=((3, 0.1), (4, 0.234), (6, 0.0)), moved=(4,)),
    "unstable_depth": evidence(moving=((3, 0.1), (4, 0.234), (6, 0.0))),
    "open_motion": evidence(moving=((3, 0.1), (4, 0.26)), moved=(4,)),
    "ambiguous_steps": replace(evidence(), ambiguous=(2, 5)),
    "range_changes": evidence(sigma=(0.0001, 0.0001), refinement=refined_with(RANGE_CHANGES)),
    "doubtful_poses": evidence(doubtful=(2, 3, 6)),
}


def test_every_reason_has_a_case() -> None:
    # Whether there is a surface is no question of trust: fusion reports it. Faults of the recording
    # itself are found before it is run; a corrected camera, one that is not where its rig states,
    # or an object that does not turn, afterwards.
    elsewhere = {"no_surface", "faulty_recording", "self_calibrated", "correction_left_out"}
    elsewhere |= {"rig_changed", "uncertain_rig", "inconsistent_poses", "object_still"}
    assert set(CASES) == set(REASONS) - elsewhere


@pytest.mark.parametrize("code", CASES)
def test_each_reason_comes_from_its_own_evidence(code) -> None:
    verdict, reasons = judge(CASES[code])
    found = [r for r in reasons if r.code == code]
    assert len(found) == 1
    assert verdict == verdict_of(reasons)
    force = {"failed": 2, "degraded": 1, "note": 0}
    assert force[REASONS[code][0]] <= {"good": 0, "degraded": 1, "failed": 2}[verdict]
    text = found[0].text
    assert text.endswith(".")
    assert "\n" not in text
    assert "nan" not in text
    first, last = found[0].frames
    assert isinstance(first, int)
    assert 0 <= first <= last < len(CASES[code].records)
    # No other reasons, except those that follow from it.
    follows = {"few_poses": {"lost_frames"}, "open_motion": {"moving_objects"}}
    assert {r.code for r in reasons} - {code} <= follows.get(code, set())


def test_moving_objects_and_unstable_depth_are_separate() -> None:
    both = evidence(moving=((1, 0.05), (2, 0.02), (4, 0.1), (5, 0.234)), moved=(5,))
    moving, unstable = judge(both)[1]
    assert (moving.code, moving.frames) == ("moving_objects", (4, 5))
    assert "up to 23 %" in moving.text
    assert (unstable.code, unstable.frames) == ("unstable_depth", (1, 2))
    assert "up to 5 %" in unstable.text


def test_rival_motion_leaves_the_choice_open() -> None:
    (reason,) = judge(replace(evidence(), rivals=((3, 0.1), (5, 0.4))))[1]
    assert (reason.code, reason.frames) == ("open_motion", (5, 5))
    assert "either may be the room" in reason.text
    assert "40 %" in reason.text
    assert not judge(replace(evidence(), rivals=((3, 0.2),)))[1]


def test_scans_from_tripods_are_not_compared_with_motion_of_a_camera() -> None:
    jumps = evidence(steps=[(0.05 * k + 0.4 * (k > 4), 0, 0, 0, 0, 0) for k in range(9)])
    untimed = tuple(replace(r, timestamp=float(r.index)) for r in jumps.records)
    scans = replace(jumps, scans=True, records=untimed)
    assert codes(scans) == []
    assert codes(replace(jumps, scans=True)) == ["jumped"]
    (reason,) = judge(replace(scans, doubtful=(2,)))[1]
    assert "camera" not in reason.text


def test_jump_that_another_sensor_measured_is_expected() -> None:
    jumps = evidence(steps=[(0.05 * k + 0.4 * (k > 4), 0, 0, 0, 0, 0) for k in range(9)])
    assert codes(jumps) == ["jumped"]
    assert codes(replace(jumps, measured=frozenset({5}))) == []


def test_motion_that_another_sensor_measured_is_not_open() -> None:
    largest = replace(evidence(), rivals=((3, 0.9), (5, 0.4)), measured=frozenset({3}))
    (reason,) = judge(largest)[1]
    assert (reason.code, reason.frames) == ("open_motion", (5, 5))
    assert "40 %" in reason.text


def test_frozen_images_are_told_from_single_repetitions() -> None:
    assert checks.frozen(((3, 3), (6, 8)))
    assert not checks.frozen(((3, 3), (5, 5)))
    (reason,) = judge(evidence(repeated=(4, 5)))[1]
    assert "no bound is stated" in reason.text
    (reason,) = judge(evidence(repeated=(4,)))[1]
    assert "no bound is stated" not in reason.text


def test_loop_error_within_expected_drift_is_no_gap() -> None:
    # Eight steps of 5 cm and 1.1 degrees: 3 cm and 2 degrees are allowed.
    assert codes(evidence(gaps=((0, 8, [0.025, 0, 0, 0, 0, 0]),))) == []
    assert codes(evidence(gaps=((0, 8, [0.035, 0, 0, 0, 0, 0]),))) == ["loop_gap"]
    assert codes(evidence(gaps=((0, 8, [0, 0, 0, 0, np.radians(1.8), 0]),))) == []
    assert codes(evidence(gaps=((0, 8, [0, 0, 0, 0, np.radians(2.2), 0]),))) == ["loop_gap"]


def test_few_unconstrained_directions_cause_no_drift() -> None:
    assert codes(evidence(("tracked",) * 21, unheld=(4, 5))) == []
    assert codes(evidence(("tracked",) * 21, unheld=(4, 5, 6))) == ["unobserved_motion"]


@pytest.mark.parametrize(
    ("depths", "ambiguity_m", "words"),
    [
        ((0.1, 0.12, 0.3), None, "is 0.12 m, nearer than"),
        ((13.0, 30.0, 14.0), None, "is 14 m, farther than"),
        ((6.0, 6.5, 7.0), 5.0, "is 6.5 m, but the camera's ambiguity range is 5 m"),
        ((6.0, 6.5, 7.0), 7.5, ""),
        ((0.25, 0.2, 11.0), None, ""),
    ],
)
def test_implausible_depth_suggests_wrong_unit(depths, ambiguity_m, words) -> None:
    reasons = judge(evidence(depths=depths, ambiguity_m=ambiguity_m))[1]
    assert [r.code for r in reasons] == ["implausible_depth"] * bool(words)
    assert all(words in r.text for r in reasons)
    assert all(r.text.endswith("check the depth unit.") for r in reasons)
    # Odometry of the same length verifies the unit, but not that the phase is unwrapped.
    sensor = SensorRecord("odometry", 8, 8, 1.0, "", metric=True)
    known = evidence(depths=depths, ambiguity_m=ambiguity_m, priors=(sensor,))
    assert bool(judge(known)[1]) is ("ambiguity" in words)


def test_small_motion_is_not_standing_still() -> None:
    for axis, size in ((0, 0.012), (4, np.radians(0.6))):
        steps = np.zeros((9, 6))
        steps[5:, axis] = size
        assert codes(evidence(steps=steps)) == []


def test_clouds_in_one_frame_are_of_no_camera_that_stood_still() -> None:
    _, reasons = judge(replace(CASES["stood_still"], scans=True))
    (still,) = (r for r in reasons if r.code == "stood_still")
    assert still.text.startswith("The 9 clouds fit as they are")


def test_images_without_overlap_give_no_evidence() -> None:
    assert codes(evidence(images=CrossViewConsistency(tuple(range(5)), ()))) == []
    assert codes(replace(evidence(), cross_view=None)) == []


def test_noise_shared_by_neighbours_is_no_difference() -> None:
    assert codes(evidence(images=seen(0.8, 0.02, 0.8, 0.02))) == []


def test_excess_distance_of_far_views_counts_in_accuracy() -> None:
    """It is no reason by itself, as the bound includes it."""
    images = seen(far_rms=0.02)
    assert codes(evidence(images=images)) == []
    assert images.excess_m() == pytest.approx(np.sqrt(0.02**2 - 0.004**2))
    assert seen(far_rms=0.001).excess_m() == 0
    assert CrossViewConsistency(tuple(range(9)), ()).excess_m() == 0


def test_inconsistent_views_are_named() -> None:
    ends = [(i, j) for i in range(9) for j in range(i + 1, 9)]
    pairs = tuple(pair(i, j, 0.2 if 6 in (i, j) else 0.99) for i, j in ends)
    (reason,) = judge(evidence(images=CrossViewConsistency(tuple(range(0, 18, 2)), pairs)))[1]
    assert (reason.code, reason.ranges) == ("images_differ", ((12, 12),))
    assert reason.text.startswith("Frame 12 is inconsistent with most overlapping frames.")


def test_verdict_is_good_within_tolerance() -> None:
    """By default 0.5 % of the model's diagonal and at least 1 cm."""
    e = evidence(gaps=(), sigma=(0.008, 0.0001))
    bound = e.accuracy.position_m
    assert 0.01 < bound < 0.03
    (reason,) = judge(e)[1]
    assert (reason.code, reason.frames) == ("uncertain_poses", (0, 8))
    assert (
        f"may reach {bound * 1e3:.0f} mm rms (95 % bound); the tolerance is 10 mm." in reason.text
    )
    assert "Most of it is due to noise." in reason.text
    assert reason.remedy == "Record more views of the same places, to average out the noise."
    assert "Frame " in reason.text
    assert codes(replace(e, diagonal_m=201 * bound)) == []
    assert codes(replace(e, diagonal_m=199 * bound)) == ["uncertain_poses"]
    assert codes(replace(e, tolerance_m=1.01 * bound)) == []
    assert codes(replace(e, tolerance_m=0.99 * bound, diagonal_m=100)) == ["uncertain_poses"]
    # A loop removes a part of the error.
    assert evidence(sigma=(0.008, 0.0001)).accuracy.position_m < 0.85 * bound


def test_rotation_has_its_own_tolerance() -> None:
    e = evidence(gaps=(), sigma=(1e-5, np.radians(0.8)))
    (reason,) = judge(replace(e, tolerance_m=10.0))[1]
    assert reason.code == "uncertain_poses"
    assert "the tolerance is 2.0°" in reason.text
    assert reason.remedy.startswith("Return to places seen before")
    assert codes(evidence(gaps=(), sigma=(1e-5, np.radians(0.1)))) == []


def test_missing_assessment_is_no_reason() -> None:
    assert codes(replace(evidence(sigma=(0.001, 0.0005)), accuracy=Accuracy())) == []


def test_gap_within_known_errors_raises_no_alarm() -> None:
    # The end of the chain is known to sqrt(9) x 1 mm along each axis, plus the effect of rotations.
    for gap, alarm in ((0.008, False), (0.03, True)):
        found = codes(evidence(gaps=((0, 8, [0, gap, 0, 0, 0, 0]),), sigma=(0.001, 0.0005)))
        assert ("calibration_alarm" in found) == alarm
        assert "loop_gap" not in found


def test_gravest_reason_decides() -> None:
    def of(*names: str) -> str:
        return verdict_of([Reason(name, ((0, 1),), "") for name in names])

    assert of() == "good"
    assert of("unreadable_frames", "moving_objects") == "good"
    assert of("single_frame") == "degraded"
    assert of("unreadable_frames", "loop_gap") == "degraded"
    assert of("loop_gap", "few_poses", "single_frame") == "failed"
    assert {force for force, _ in REASONS.values()} == {"failed", "degraded", "note"}


def test_reasons_are_merged_and_sorted() -> None:
    reasons = ranked(
        [
            Reason("stood_still", ((0, 99),), "note."),
            Reason("loop_gap", ((3, 5),), "small."),
            Reason("jumped", ((9, 9), (11, 12)), "b."),
            Reason("jumped", ((1, 8),), "a."),
            Reason("jumped", ((1, 2),), "a."),
            Reason("few_poses", ((4, 4),), "grave."),
        ]
    )
    assert [r.code for r in reasons] == ["few_poses", "jumped", "loop_gap", "stood_still"]
    assert reasons[1] == Reason("jumped", ((1, 9), (11, 12)), "b. a.")
    assert reasons[1].frames == (1, 12)
    assert [bool(r.remedy) for r in reasons] == [True, False, True, False]


def test_short_main_model_fails_unless_it_is_that_of_the_first_session() -> None:
    short = in_components(apart((3, 8)))
    assert codes(short) == ["few_poses", "disconnected"]
    assert codes(replace(short, main_is_first=True)) == ["disconnected"]


def test_disconnected_parts_are_named() -> None:
    (reason,) = judge(CASES["disconnected"])[1]
    assert reason.ranges == ((7, 8),)
    text = "The recording consists of 2 disconnected parts: frames 0-6, 7-8; no "
    text += "pose between them could be verified."
    assert reason.text == text
    (bridged,) = judge(CASES["bridged_gap"])[1]
    text = "Frames 5-8 are connected to the rest by extrapolated motion only."
    assert (bridged.text, bridged.ranges) == (text, ((5, 8),))
    measured = replace(CASES["bridged_gap"], accuracy=Accuracy(0.005, 0.001, 0.001, True))
    assert codes(measured) == []
    loose = replace(measured, accuracy=Accuracy(assessed=True, unbounded=(5, 6, 7, 8)))
    assert "bridged_gap" in codes(loose)
    (hanging,) = judge(CASES["single_link"])[1]
    text = "Frames 5-8 are connected to the rest by a single registration, which no other view "
    assert (hanging.text, hanging.ranges) == (text + "confirms.", ((5, 8),))


def test_parts_of_several_ranges_with_lost_frames() -> None:
    linked = Component(((6, 8),), se3.exp(np.full(6, 0.1)), "links")
    e = in_components(linked, apart((10, 11), (14, 15)), frames=20, lost=(5, 9))
    verdict, (parts, lost) = judge(e)
    assert verdict == "degraded"
    assert (parts.code, parts.ranges) == ("disconnected", ((10, 11), (14, 15)))
    # What is linked to the main part belongs to it; lost frames belong to none.
    assert "frames 0-4, 6-8, 12-13, 16-19; frames 10-11, 14-15; no pose" in parts.text
    assert (lost.code, lost.ranges) == ("lost_frames", ((5, 5), (9, 9)))


def test_less_than_half_in_main_model_is_failure() -> None:
    e = in_components(apart((4, 6)), apart((7, 8)), frames=9)
    assert codes(e) == ["few_poses", "disconnected"]
    assert judge(e)[1][0].text == "Only 4 of 9 readable frames are in the main model."
    assert codes(in_components(apart((5, 8)), frames=9)) == ["disconnected"]


def test_unconnected_single_frames_are_failure() -> None:
    for n in (2, 5):
        e = in_components(*(apart((k, k)) for k in range(1, n)), frames=n)
        verdict, reasons = judge(e)
        assert verdict == "failed"
        assert [r.code for r in reasons] == ["few_poses", "disconnected"]
    # A single view is neither known to be wrong nor known to be correct.
    assert judge(evidence(("tracked",)))[0] == "degraded"


def test_component_that_starts_elsewhere_is_no_jump() -> None:
    e = in_components(Component(((5, 8),), np.eye(4), "links"))
    moved = e.sequential.copy()
    moved[5:] = se3.exp(np.array([3.0, 0, 0, 0, 1, 0])) @ moved[5:]
    assert "jumped" not in codes(replace(e, sequential=moved))
    same = replace(e, records=tuple(replace(r, component=0) for r in e.records))
    assert "jumped" in codes(replace(same, sequential=moved))


def test_calibration_without_loop_confirmation_is_noted() -> None:
    """Only a note: the factory calibration of a camera is usually right."""
    estimates = {"focal": (-0.05, 0.003)}
    found = CalibrationCheck(False, {"focal": -0.05}, support=(0.8, 0.85), estimates=estimates)

    def warnings_of(suspicion: CalibrationCheck, **more: Any) -> list[str]:
        more |= {"gaps": (), "sigma": (0.001, 0.001)}
        case = evidence(refinement=refined_with(suspicion), **more)
        return [r.text for r in judge(case)[1] if r.code == "unchecked_calibration"]

    (text,) = warnings_of(found)
    assert "a focal length 5.3 % larger, but no loop closure confirms it" in text
    (text,) = warnings_of(UNDETERMINED)
    assert "does not determine the camera's focal length" in text
    assert text.endswith("allows for an error of 1 %. It would move the poses by 30 mm.")
    (text,) = warnings_of(UNDETERMINED, priors=(SensorRecord("odometry", 8, 8, 1.0, ""),))
    assert text.endswith(
        "by 30 mm, but the recorded odometry, or the device's own poses, limit that."
    )
    # Another error is named where it would move the poses more, and limits the bound.
    off_center = replace(UNDETERMINED, motion={"focal": (3.0, 0.2), "center_x": (5.0, 0.2)})
    (text,) = warnings_of(off_center)
    assert "principal point: the stated accuracy allows for an error of 1 % of the focal" in text
    small = Gap(2, 7, (0.006, 0.005), (0.006, 0.008))  # too small to tell
    assert warnings_of(replace(found, gap=small)) == warnings_of(found)
    gap = Gap(2, 7, (0.03, 0.02), (0.03, 0.02), 1.0, (0.03, 0.02))  # changed, not closed
    short = Gap(2, 4, (0.03, 0.02), (0.03, 0.02), 1.0, (0.003, 0.002))  # hardly changed
    assert warnings_of(replace(found, gap=short)) == warnings_of(found)
    for quiet in (
        CalibrationCheck(estimates={"focal": (0.0, 0.001)}),  # determined, and as stated
        CalibrationCheck(),  # not asked: too few views
        replace(found, errors={"focal": -0.005}),  # within what a calibration is good to
        replace(found, gap=gap),  # a loop speaks against it
        replace(found, alarm=True, gap=gap),  # which is an alarm
    ):
        assert warnings_of(quiet) == []


def test_scanners_see_farther_than_cameras() -> None:
    far = evidence(depths=(25.0,) * 9)
    assert [r.code for r in judge(far)[1]] == ["implausible_depth"]
    assert "implausible_depth" not in [r.code for r in judge(replace(far, scans=True))[1]]
    (reason,) = judge(replace(far, scans=True, depths=(2500.0,) * 9))[1]
    assert "farther than scanners see" in reason.text
