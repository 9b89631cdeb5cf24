"""Loops of range images: the camera turns away from a corner, and returns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import revisited_path
from corner_views import corner
from pose_errors import pose_error
from revisited_path import ALL, DRIFT, pushed
from tofuse.engine.alignment.base import Registration
from tofuse.engine.geometry import se3
from tofuse.engine.loops import revisits
from tofuse.engine.loops.candidates import revisited
from tofuse.engine.loops.information_gain import InformationGain
from tofuse.engine.loops.loops import PriorLoop
from tofuse.engine.loops.revisits import Revisits
from tofuse.engine.search import verification
from tofuse.engine.search.pose_probability import ACCEPTED
from tofuse.engine.search.verification import FitQuality
from tofuse.engine.stored_views.view_store import SampledView, ViewStore
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions

turn = revisited_path.turn  # the fixture


def test_revisited_place_is_measured_despite_drift(turn):
    frames, truth, start = turn
    closed = [c for c in pushed(Revisits(searches=0), frames, start) if c.record.accepted]
    assert closed
    assert any(c.record.i == 0 and c.record.j >= 11 for c in closed)
    for c in closed:
        i, j = c.record.i, c.record.j
        true = se3.inverse(truth[i]) @ truth[j]
        drifted = se3.inverse(start[i]) @ start[j]
        error = np.linalg.norm((se3.inverse(true) @ c.T_i_j)[:3, 3])
        assert error < 0.01
        assert error < 0.3 * np.linalg.norm((se3.inverse(true) @ drifted)[:3, 3])
        assert np.linalg.eigvalsh(c.information).min() > 0
        assert c.record.overlap > 0.3


def test_continuously_overlapping_views_are_no_loop(turn):
    frames, _truth, start = turn
    half = 6
    assert pushed(Revisits(), frames[:half], start[:half]) == []
    # A static camera sees the same all the time, and never left it.
    still = [replace(frames[0], index=k) for k in range(5)]
    assert pushed(Revisits(), still, np.stack([np.eye(4)] * 5)) == []


def test_loop_to_the_least_certain_view_is_tried_as_well():
    """Laps that agree overlap most, but what connects them with the first one is unknown."""
    places = [0.0, 1.2] * 4  # yaw: the camera looks at one place, then at another
    aside = [0.15, 0.15, 0.1, 0.1, 0, 0, 0, 0]  # of the poses on the trajectory, m
    truth, poses = (
        se3.exp(np.array([[x, 0, 0, 0, yaw, 0] for x, yaw in zip(shift, places, strict=True)]))
        for shift in ([0.0] * 8, aside)
    )
    options = SurfaceOptions(radii=(2,))
    views = [SampledView.of(prepare_view(corner(T), options), 600) for T in truth]

    def candidates(variance, per_view=1):
        return revisited(views, poses, 0.4, per_view, InformationGain(variance), first=6)

    found = candidates(np.zeros(8))
    assert list(found) == [(4, 6), (5, 7)]
    assert all(overlap > 0.9 for overlap in found.values())
    variance = np.array([0.0, 0.0, 0.3, 0.3, 1.0, 1.0, 1.1, 1.1])
    found = candidates(variance)
    assert list(found) == [(0, 6), (4, 6), (1, 7), (5, 7)]
    assert found[0, 6] < found[4, 6]
    # Differences within the accuracy of a loop don't count.
    assert list(candidates(1e-5 * variance)) == [(4, 6), (5, 7)]
    assert candidates(variance, per_view=0) == {}


@pytest.mark.parametrize(("succeeding", "asked"), [(0, 2), (1, 3), (9, 4)])
def test_failed_searches_are_limited(monkeypatch, succeeding, asked):
    """Of four rejected candidates, each of which gains information."""
    monkeypatch.setattr(revisits, "follow", lambda *_, **__: None)
    searched = []

    def scripted(source, target, **_):
        searched.append(len(searched))
        return registered(np.eye(4), 1.0 if len(searched) <= succeeding else 0.1)

    monkeypatch.setattr(revisits, "register_pair", scripted)
    yaw = [0.0, 1.2, 2.4, 3.6] * 2
    poses = se3.exp(np.array([[0, 0, 0, 0, a, 0] for a in yaw]))
    frames = [replace(corner(poses[0]), index=k) for k in range(8)]
    variances = {k: np.eye(6) * k for k in range(8)}
    found = pushed(
        Revisits(per_view=1, searches=2, similar_pairs=0), frames, poses, covariances=variances
    )
    assert len(searched) == asked
    assert sum(c.record.accepted for c in found) == min(succeeding, 4)


def test_view_of_another_place_is_rejected_with_reason(turn):
    """The last views show another place, but overlap with the first by the trajectory."""
    frames, truth, start = turn
    strange = [
        *frames[:11],
        *(
            replace(corner(truth[k] @ se3.exp(np.array([0, 0, -0.8, 0.5, 0.4, 0.6]))), index=k)
            for k in (11, 12)
        ),
    ]
    options = Revisits(overlap=0.15, searches=0)
    late = [c for c in pushed(options, strange, start) if c.record.j >= 11]
    assert late
    for c in late:
        assert not c.record.accepted
        assert c.record.reason
        assert c.T_i_j is None


def test_given_loops_are_used(turn):
    frames, truth, start = turn
    T = se3.inverse(truth[0]) @ truth[12]
    given = [PriorLoop(0, 12, T), PriorLoop(1, 11), PriorLoop(0, 99)]
    found = pushed(Revisits(per_view=0), frames, start, given)
    by_pair = {(c.record.i, c.record.j): c for c in found}
    assert list(by_pair) == [(1, 11), (0, 12), (0, 99)]
    np.testing.assert_array_equal(by_pair[0, 12].T_i_j, T)
    measured = by_pair[1, 11]
    assert measured.record.accepted
    assert pose_error(measured.T_i_j, se3.inverse(truth[1]) @ truth[11])[0] < 0.01
    assert by_pair[0, 99].record.reason == "frame 99 has no pose"


def registered(T, probability):
    accepted = probability >= ACCEPTED
    reason = "" if accepted else "another pose fits nearly as well"
    return Registration(
        T, True, 9, 1800, 2000, 0.1, 0.003, 1e4 * np.eye(6), margin=0.1,
        believed=accepted, probability=probability, reason=reason,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("probable", "wrong", "accepted"),
    [
        ((0.99, 0.99), (), 2),  # each is accepted
        ((0.7, 0.7), (), 2),  # both agree
        ((0.7, 0.7), (1,), 0),  # they contradict each other
        ((0.7, 0.99), (0,), 1),  # only the accepted one is used
        ((0.3, 0.3), (), 0),  # improbable
    ],
)
def test_searched_loops_are_accepted_or_agree(turn, monkeypatch, probable, wrong, accepted):
    frames, truth, start = turn
    options = Revisits(per_view=3)
    asked = []

    def scripted(source, target, **_):
        k = len(asked)
        asked.append((target.index, source.index))
        if k >= len(probable):
            return None
        T = se3.inverse(truth[target.index]) @ truth[source.index]
        if k in wrong:
            T = T @ se3.exp(np.array([0.5, 0, 0, 0, 0, 0]))
        return registered(T, probable[k])

    monkeypatch.setattr(revisits, "register_pair", scripted)
    # Nothing fits from the drifted pose, so that only the search can succeed.
    monkeypatch.setattr(
        verification.FitStatistics,
        "assess",
        lambda *_: FitQuality("conflicting", np.inf, "does not fit"),
    )
    found = pushed(options, frames, start)
    assert len(asked) >= 2
    assert sum(c.record.accepted for c in found) == accepted
    for c in found:
        if c.record.accepted:
            assert "search" in c.record.reason
            true = se3.inverse(truth[c.record.i]) @ truth[c.record.j]
            assert pose_error(c.T_i_j, true)[0] < 0.05


def test_loops_are_searched_again_after_views_moved(turn):
    frames, truth, start = turn
    # Drift that bends the path so far that no candidate is left.
    far = [truth[0]]
    bend = se3.exp(5 * se3.log(DRIFT))
    for k in range(1, len(truth)):
        far.append(far[-1] @ se3.inverse(truth[k - 1]) @ truth[k] @ bend)
    store = ViewStore(ALL)
    loops = Revisits(searches=0, similar_pairs=0).start(0, (), store, spacing=ALL)
    for frame, T in zip(frames, far, strict=True):
        store.push(prepare_view(frame, SurfaceOptions(radii=(2,))), T)
        loops.push(frame, T)
    unsure = {f.index: np.zeros((6, 6)) for f in frames}

    def accepted(poses):
        known = {f.index: T for f, T in zip(frames, poses, strict=True)}
        return {(c.record.i, c.record.j) for c in loops.finish(known, unsure) if c.record.accepted}

    first = accepted(far)
    assert (0, 12) not in first
    assert not loops.candidates_change(dict(enumerate(far)))
    assert loops.candidates_change(dict(enumerate(start)))
    again = accepted(start)
    assert again >= first
    assert any(i == 0 and j >= 11 for i, j in again)
    assert not loops.is_long
