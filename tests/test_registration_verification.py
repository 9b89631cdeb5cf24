"""What is believed of an alignment: how views usually fit, and what beats its rivals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from made_rooms import BOXES, OTHER, at, seen, surface
from tofuse.geometry import se3
from tofuse.registration import verification
from tofuse.registration.agreement import Agreement
from tofuse.registration.projective import Aligned
from tofuse.registration.search import Candidate, Match
from tofuse.registration.verification import (
    Belief,
    UsualFit,
    aligned_link,
    comparable,
    searched_link,
    self_scaled,
)


def aligned(outliers=0.1, in_front=0.01, noise=2.0, albedo=0.04, compared=2000, rms_m=0.01):
    """An alignment with these fractions of outliers and of points in free space."""
    return Aligned(
        np.eye(4),
        True,
        5,
        np.eye(6),
        np.eye(6),
        np.zeros((0, 6)),
        compared,
        compared,
        compared,
        round((1 - outliers) * compared),
        round(in_front * compared),
        rms_m,
        min(noise, 3.0),
        albedo,
        0.8,
        photometric=albedo > 0,
        noise_scale=noise,
    )


def taught(count=60, seed=0, spread=0.15, **usual):
    """What is usual for a camera whose views fit like this, give or take."""
    rng = np.random.default_rng(seed)
    known = UsualFit()
    for _ in range(count):
        several = {
            name: value * np.exp(spread * rng.standard_normal()) for name, value in usual.items()
        }
        known.learn(aligned(**several), 2.0)
    return known


# How views of a camera usually fit


@pytest.mark.parametrize(
    "fit",
    [
        {},
        {"outliers": 0.0, "in_front": 0.0, "noise": 0.5, "albedo": 0.005},
        {"outliers": 0.35},
        {"in_front": 0.08},
        {"noise": 30.0},
        {"albedo": 0.1},
        {"albedo": 0.0},
    ],
)
def test_of_a_camera_that_is_not_known_much_is_usual(fit):
    found = UsualFit().assess(aligned(**fit))
    assert found.usual
    assert found.excess == 0
    assert found.reason == ""


@pytest.mark.parametrize(
    ("fit", "words"),
    [
        ({"outliers": 0.8}, "80% outliers, usually"),
        ({"in_front": 0.5}, "50% free-space violations, usually"),
        ({"noise": 10000.0}, "noise 2500.0 times as large as usual"),
        ({"albedo": 3.0}, "albedo differences 60.0 times as large as usual"),
    ],
)
def test_but_not_everything(fit, words):
    found = UsualFit().assess(aligned(**fit))
    assert not found.usual
    assert words in found.reason
    assert 0 < found.excess < np.inf


def test_too_few_inliers_determine_no_pose():
    found = UsualFit().assess(aligned(compared=30, outliers=0.0))
    assert not found.usual
    assert "30 inliers are too few" in found.reason
    assert found.excess == np.inf
    assert UsualFit().assess(aligned(compared=100, outliers=0.0)).usual


def test_what_is_usual_is_learnt_of_each_camera():
    """A third of outliers is as ever for one camera, and out of the ordinary for another."""
    many, few = taught(outliers=0.3), taught(outliers=0.03)
    third = aligned(outliers=0.3)
    assert many.assess(third).usual
    assert not few.assess(third).usual
    assert "30% outliers, usually" in few.assess(third).reason
    for known in (many, few):
        assert known.assess(aligned(outliers=0.03)).usual
        assert not known.assess(aligned(outliers=0.85)).usual


@pytest.mark.parametrize(
    ("usual", "twice", "far"),
    [
        ({"in_front": 0.01}, {"in_front": 0.02}, {"in_front": 0.3}),
        ({"noise": 2.0}, {"noise": 4.0}, {"noise": 40.0}),
        ({"albedo": 0.05}, {"albedo": 0.1}, {"albedo": 1.0}),
    ],
)
def test_each_statistic_has_its_own_range(usual, twice, far):
    known = taught(**usual)
    assert known.assess(aligned(**twice)).usual
    assert not known.assess(aligned(**far)).usual


def test_however_even_a_recording_the_next_view_may_be_of_another_kind():
    known = taught(200, spread=0.0, outliers=0.1)
    assert known.assess(aligned(outliers=0.18)).usual
    assert not known.assess(aligned(outliers=0.5)).usual


def test_a_few_wrong_ones_do_not_change_what_is_usual():
    """Location and spread are medians."""
    known = taught(outliers=0.05)
    for _ in range(15):
        known.learn(aligned(outliers=0.7), 2.0)
    assert not known.assess(aligned(outliers=0.7)).usual
    # The order does not matter.
    other = UsualFit()
    for _ in range(15):
        other.learn(aligned(outliers=0.7), 2.0)
    assert not all(other.assess(aligned(outliers=x)).usual for x in (0.05, 0.9))


def test_the_stricter_the_fewer_are_usual():
    fits = [aligned(outliers=x) for x in np.linspace(0, 0.9, 40)]
    counts = []
    for sigmas in (1.0, 3.0, 6.0):
        known = UsualFit(sigmas)
        for _ in range(20):
            known.learn(aligned(), 2.0)
        found = [known.assess(fit) for fit in fits]
        # From some fraction on all are unusual, the more so the more outliers there are.
        usual = [f.usual for f in found]
        assert usual == sorted(usual, reverse=True)
        excess = [f.excess for f in found if not f.usual]
        assert excess == sorted(excess)
        counts.append(sum(usual))
    assert counts[0] < counts[1] <= counts[2]


def test_the_noise_scale_is_known_after_some_alignments():
    known = UsualFit()
    assert known.noise_scale == 0
    assert known.rms_share == 0
    known.learn(aligned(noise=8.0), 2.0)
    assert known.noise_scale == 0
    known = taught(150, noise=8.0, spread=0.1)
    assert known.noise_scale == pytest.approx(8.0, rel=0.1)
    assert known.rms_share == pytest.approx(0.005)
    # What can't be measured teaches nothing.
    for noise in (0.0, np.inf):
        known.learn(aligned(noise=noise, rms_m=np.inf), 2.0)
    assert known.noise_scale == pytest.approx(8.0, rel=0.1)
    assert known.rms_share == pytest.approx(0.005)


def test_images_are_compared_as_coarsely_as_the_camera_errs():
    fine, coarse = self_scaled(UsualFit()), UsualFit()
    for _ in range(10):
        coarse.learn(aligned(rms_m=0.1), 2.0)
    assert self_scaled(coarse).floor_share == pytest.approx(0.1)
    assert self_scaled(coarse).floor_share > fine.floor_share


def test_views_of_another_scale_are_not_compared():
    assert comparable(2.0, 2.0)
    assert comparable(2.0, 5.0)
    assert not comparable(2.0, 20.0)
    assert not comparable(20.0, 2.0)


# What is believed of a search


def match(score, rival, violation=0.0, support=None):
    support = score + 2 * violation if support is None else support
    said = Agreement(0.6, support, violation, 0.0, 0.01, 1000, score)
    other = Agreement(0.6, rival, 0.0, 0.0, 0.01, 1000, rival)
    return Match((Candidate(np.eye(4), said), Candidate(np.eye(4), other)), "full")


def test_a_search_is_believed_with_a_lead_and_without_contradiction():
    belief = Belief()

    def believed(found, alone=False):
        return not belief.objection(found, alone=alone)

    assert believed(match(0.5, 0.4))
    assert not believed(match(0.2, 0.15))
    assert not believed(match(0.5, 0.49))
    assert not believed(match(0.5, 0.4, 0.1))
    # It lies where surfaces are, which reflect otherwise.
    assert not believed(match(0.05, 0.0, support=0.55))
    # What leads clearly may be a small part of what both see.
    assert believed(match(0.2, 0.05))
    assert not believed(match(0.14, 0.0))
    # Alone it must lead clearly: places look alike.
    assert not believed(match(0.5, 0.45), alone=True)
    assert believed(match(0.5, 0.2), alone=True)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (match(0.1, 0.0), "no pose has the support of 15% of the points"),
        (match(0.05, 0.0, support=0.5), "contradicted by albedo or free space"),
        (match(0.5, 0.49), "leads its runner-up by 1.0% of the points only"),
        (match(0.4, 0.5), "leads its runner-up by 0.0% of the points only"),
        (match(0.2, 0.15), "has the support of 20% of the points only"),
        (match(0.5, 0.4, 0.1), "17% of the overlap contradicts"),
    ],
)
def test_why_it_is_not_believed(found, words):
    assert words in Belief().objection(found, alone=False)


@pytest.mark.parametrize("name", ["support", "score", "margin", "clear_margin", "contradiction"])
@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan")])
def test_beliefs_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        Belief(**{name: value})


# Links between views


A = at(0.0, 0.3, 0.0)


def error(T, true):
    off = se3.inverse(true) @ T
    return float(np.linalg.norm(off[:3, 3])), float(np.degrees(se3.angle(off)))


def assert_right(link, true):
    metres, degrees = error(link.T_i_j, true)
    assert metres < 0.01
    assert degrees < 0.3
    assert np.linalg.eigvalsh(link.information).min() > 0


@pytest.fixture(scope="module")
def target():
    return surface(seen(A, 3))


@pytest.mark.parametrize("yaw", [0.12, 0.35])
def test_a_search_links_views_of_one_place(target, yaw):
    B = A @ se3.exp([0.1, 0, 0.05, 0, yaw, 0])
    link, doubt = searched_link(surface(seen(B, 8)), target, Belief(), UsualFit())
    assert (link.i, link.j) == (3, 8)
    assert doubt == ""
    assert link.certain
    assert link.margin > 0.1
    assert "margin" in link.how
    assert_right(link, se3.inverse(A) @ B)


def test_without_a_clear_lead_a_link_is_certain_only_where_something_else_agrees(
    target, monkeypatch
):
    B = A @ se3.exp([0.1, 0, 0.05, 0, 0.35, 0])
    belief, source, true = Belief(clear_margin=0.95), surface(seen(B, 8)), se3.inverse(A) @ B
    # An alignment from the identity ends there, too.
    link, doubt = searched_link(source, target, belief, UsualFit())
    assert link.certain
    assert doubt == ""
    monkeypatch.setattr(verification, "aligned_link", lambda *_: None)
    link, doubt = searched_link(source, target, belief, UsualFit())
    assert not link.certain
    assert "leads its runner-up" in doubt
    assert_right(link, true)
    # The views are adjacent in time.
    link, doubt = searched_link(source, target, belief, UsualFit(), adjacent=True)
    assert link.certain
    assert doubt == ""
    assert_right(link, true)


def test_views_of_two_scenes_are_not_linked(target):
    for k, yaw in enumerate((0.0, 1.5, 3.0)):
        frame = seen(at(0.1, 0.0, yaw), 10 + k, boxes=OTHER, half=(2.3, 1.2, 2.2), scene=9)
        link, why = searched_link(surface(frame), target, Belief(), UsualFit())
        assert link is None or not link.certain
        assert why
        assert aligned_link(surface(frame), target, np.eye(4), UsualFit()) is None


def test_views_of_opposite_walls_are_not_linked(target):
    source = surface(seen(A @ se3.exp([0, 0, 0, 0, np.pi, 0]), 8))
    link, why = searched_link(source, target, Belief(), UsualFit())
    assert link is None
    assert why


def test_a_square_room_without_furniture_is_no_certain_match():
    """Each corner is like the next: two poses fit as well."""
    bare = {"boxes": (), "spots": 0, "half": (1.8, 1.1, 1.8)}
    views = [surface(seen(at(0, 0, yaw), k, **bare)) for k, yaw in enumerate((0.0, np.pi / 4))]
    link, why = searched_link(views[1], views[0], Belief(), UsualFit())
    assert link is None or not link.certain
    assert "runner-up" in why


def test_views_of_different_scale_are_not_searched(target):
    frame = seen(A, 8)
    small = type(frame)(8, 0.8, frame.camera, frame.depth * np.float32(0.1), "z")
    assert searched_link(surface(small), target, Belief(), UsualFit()) == (
        None,
        "the views are of different scale",
    )
    assert aligned_link(surface(small), target, np.eye(4), UsualFit()) is None


def test_an_alignment_links_views_if_it_holds_both_ways(target):
    B = A @ se3.exp([0.08, 0, 0.05, 0, 0.1, 0])
    source, true = surface(seen(B, 8)), se3.inverse(A) @ B
    link = aligned_link(source, target, np.eye(4), UsualFit())
    assert (link.i, link.j) == (3, 8)
    assert not link.certain  # nothing was compared with it
    assert link.margin is None
    assert_right(link, true)
    # The other way round it says the same.
    back = aligned_link(target, source, np.eye(4), UsualFit())
    assert_right(back, se3.inverse(true))
    # From far off nothing is found, rather than something wrong.
    off = se3.exp([0.5, 0.2, 0.6, 0.2, 1.2, 0])
    found = aligned_link(source, target, off, UsualFit())
    assert found is None or error(found.T_i_j, true)[0] < 0.02
    # Nothing is exact enough for no tolerance at all.
    assert aligned_link(source, target, np.eye(4), UsualFit(), (0.0, 0.0)) is None


def test_a_wall_holds_no_alignment():
    bare = {"boxes": (), "spots": 0}
    views = [surface(seen(at(x, 1.0, 0.0, pitch=0.0), k, **bare)) for k, x in enumerate((0, 0.1))]
    assert aligned_link(views[1], views[0], np.eye(4), UsualFit()) is None


def test_the_largest_overlap_along_a_wall_is_no_evidence():
    """Any place along it fits; the one where the views cover each other has the most points."""
    views = []
    for k, x in enumerate((0.0, 0.2)):
        frame = seen(at(x, 1.0, 0.0, pitch=0.0), k, boxes=(), spots=0)
        views.append(surface(replace(frame, amplitude_image=None)))
    link, why = searched_link(views[1], views[0], Belief(), UsualFit())
    assert link is None
    assert "degenerate" in why


def test_what_the_other_view_saw_through_is_no_link(target):
    """The same view, but a box stands in front of the camera."""
    box = ((0.0, 0.2, 1.05), (0.35, 0.4, 0.1), 0.0)
    B = A @ se3.exp([0.02, 0, 0.0, 0, 0.02, 0])
    usual = UsualFit()
    for _ in range(20):
        usual.learn(aligned(outliers=0.02, in_front=0.0), 2.0)
    blocked = surface(seen(B, 8, boxes=(*BOXES, box)))
    assert aligned_link(surface(seen(B, 8)), target, np.eye(4), usual) is not None
    assert aligned_link(blocked, target, np.eye(4), usual) is None
