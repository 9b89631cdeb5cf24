"""Pairwise registration of consecutive views: predicted motion."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tofuse.engine.alignment.base import Registration
from tofuse.engine.clouds.pair import AnyPair
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.tracking.pairwise import Pairwise

ALONG_X = np.eye(6)[:1]
POINTS = np.random.default_rng(0).uniform(-1, 1, (40, 3)).astype(np.float32)


@dataclass(frozen=True)
class Scripted(AnyPair):
    """Returns scripted motions; records the initial guesses."""

    motions: tuple[float, ...] = ()
    degenerate_from: int = 1_000
    guesses: list[float] = field(default_factory=list)

    def register(self, source, target, guess, rng):
        k = source.index
        degenerate = k >= self.degenerate_from
        if not self.search:
            self.guesses.append(float(guess[0, 3]))
        x = float(guess[0, 3]) if degenerate and guess is not None else self.motions[k]
        return Registration(
            T_target_source=se3.exp(np.array([x, 0, 0, 0, 0, 0])),
            converged=True,
            iterations=1,
            correspondences=100,
            points=100,
            error=0.0,
            rms_m=0.0,
            information=np.eye(6),
            unobservable=ALONG_X if degenerate else np.zeros((0, 6)),
            errors=(),
            believed=True,
            probability=0.99,
            reason="",
        )


def test_mean_motion_is_extrapolated_along_degenerate_directions() -> None:
    """Not the last motion, whose noise would accumulate."""
    motions = (0.0, *[0.1] * 8, 0.13, *[0.1] * 6)
    method = Scripted(motions=motions, degenerate_from=10)
    tracker = Pairwise(registration=method).start(0)
    steps = [tracker.push(CloudFrame(k, float(k), POINTS)) for k in range(len(motions))]
    assert all(step.status == "tracked" for step in steps)
    # While all directions are constrained, the last motion is extrapolated.
    np.testing.assert_allclose(method.guesses[2:9], 0.1, atol=1e-9)
    np.testing.assert_allclose(method.guesses[9], 0.13, atol=1e-9)
    # From the second one on the mean, in which the last motion has a weight of 30 %.
    assert all(0.1 < guess < 0.12 for guess in method.guesses[11:])


def test_interruption_resets_predicted_motion() -> None:
    method = Scripted(motions=(0.0, 0.1, 0.1, 0.1))
    tracker = Pairwise(registration=method).start(0)
    for k in (0, 1, 2):
        tracker.push(CloudFrame(k, float(k), POINTS))
    tracker.interrupt()
    tracker.push(CloudFrame(3, 3.0, POINTS))
    np.testing.assert_allclose(method.guesses, [0.0, 0.1, 0.0], atol=1e-9)


def test_guesses_far_from_the_pose_of_a_search_are_not_aligned() -> None:
    method = Scripted(motions=(0.0, 2.0, 2.0, 2.0, 5.0, 8.0))
    tracker = Pairwise(registration=method).start(0)
    for k in range(6):
        tracker.push(CloudFrame(k, float(k), POINTS))
    # Not 0 for the first motion. Once confirmed, predictions are aligned before a search.
    np.testing.assert_allclose(method.guesses, [2.0, 2.0, 2.0, 5.0], atol=1e-9)


def test_odometry_of_another_recording_is_in_another_frame() -> None:
    method = Scripted(motions=(0.0, 0.1, 0.1, 0.1))
    tracker = Pairwise(registration=method, guess="odometry").start(0)
    for k, x in enumerate((0.0, 0.1, 7.0, 7.1)):
        if k == 2:
            tracker.interrupt()
        tracker.push(CloudFrame(k, float(k), POINTS), se3.translation([x, 0, 0]))
    np.testing.assert_allclose(method.guesses, [0.1, 0.0, 0.1], atol=1e-9)


@dataclass(frozen=True)
class Doubtful(AnyPair):
    """Searches find a pose that is probable, or none; alignments find the one near their guess."""

    searched: tuple[float | None, ...] = ()
    actual: tuple[float, ...] = ()

    def register(self, source, target, guess, rng):
        k = source.index
        x, probability = self.searched[k], 0.8
        if not self.search:
            near = abs(guess[0, 3] - self.actual[k]) < 0.1
            x, probability = (self.actual[k] if near else float(guess[0, 3])), 0.95 if near else 0.1
        if x is None:
            x, probability = 0.0, 0.1
        T = se3.exp(np.array([x, 0, 0, 0, 0, 0]))
        return Registration(
            T, True, 1, 100, 100, 0.0, 0.0, np.eye(6),
            believed=probability >= 0.9, probability=probability, reason="doubtful",
        )  # fmt: skip


def followed(guess, odometry, searched):
    """The steps of views that move by a metre each, with odometry's positions."""
    method = Doubtful(searched=searched, actual=(0.0, *[1.0] * (len(odometry) - 1)))
    tracker = Pairwise(registration=method, guess=guess).start(0)
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3)).astype(np.float32)
    return [
        tracker.push(CloudFrame(k, float(k), points), se3.exp([x, 0, 0, 0, 0, 0.0]))
        for k, x in enumerate(odometry)
    ]


def test_odometry_that_agrees_with_searches_replaces_them() -> None:
    """At first it confirms probable poses of searches; then it connects views without one."""
    odometry = (0.0, 1.03, 1.98, 3.02, 4.0)
    steps = followed("odometry", odometry, (0.0, 1.0, 1.0, None, None))
    assert [step.component for step in steps] == [0] * 5
    assert not any(step.doubtful for step in steps)
    np.testing.assert_allclose(steps[-1].T_component_camera[0, 3], 4.0)
    # Without odometry as guess, poses are doubtful, and views disconnected.
    steps = followed("previous", odometry, (0.0, 1.0, 1.0, None, None))
    assert steps[1].doubtful
    assert steps[3].component == 1


def test_odometry_that_contradicts_searches_is_not_used() -> None:
    steps = followed("odometry", (0.0, 2.0, 4.0, 6.0, 8.0), (0.0, 1.0, 1.0, None, None))
    assert steps[1].doubtful
    assert steps[2].doubtful
    assert steps[3].component == 1


@dataclass(frozen=True)
class LooksAlike(AnyPair):
    """Searches of (source, target) lead to scripted positions; what is free contradicts some.

    `searched` holds the position of the source's component in the target's, which is the view's as
    long as all are a metre apart, and the probability.
    """

    searched: dict[tuple[int, int], tuple[float, float]] = field(default_factory=dict)
    contradicted: tuple[float, ...] = ()

    def register(self, source, target, guess, rng):
        x, p = self.searched.get((source.index, target.index), (0.0, 0.1))
        if not self.search:
            x, p = float(guess[0, 3]), 0.95
        offset = x - (source.index - target.index)  # from the right pose
        return Registration(
            se3.exp(np.array([x, 0, 0, 0, 0, 0])), True, 1, 100, 100, 0.0, 0.0, np.eye(6),
            believed=p >= 0.9, probability=p, reason="doubtful",
            contradiction=0.01 if round(offset, 6) in self.contradicted else 0.0,
        )  # fmt: skip


def steps_of(method: AnyPair, count: int):
    tracker = Pairwise(registration=method, guess="identity").start(0)
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3)).astype(np.float32)
    return [tracker.push(CloudFrame(k, float(k), points)) for k in range(count)]


def test_contradicted_registration_to_farther_view_is_rejected() -> None:
    """It places the third view 4 m off, in another room; that to the second one may be right."""
    searched = {(1, 0): (1.0, 0.99), (2, 1): (1.0, 0.4), (2, 0): (-2.0, 0.99)}
    assert steps_of(LooksAlike(searched=searched, contradicted=(-4.0,)), 3)[2].component == 1
    # What is free does not decide between both, and the other is less probable than not.
    assert steps_of(LooksAlike(searched=searched), 3)[2].component == 0
    searched[2, 1] = (-3.0, 0.4)  # both agree
    assert steps_of(LooksAlike(searched=searched), 3)[2].component == 0
    # Free space excludes the other pose.
    searched |= {(2, 1): (-3.0, 0.4), (2, 0): (2.0, 0.99)}
    step = steps_of(LooksAlike(searched=searched, contradicted=(-4.0,)), 3)[2]
    assert (step.component, step.reference, step.doubtful) == (0, 0, False)


def test_contradicted_link_is_rejected() -> None:
    """Of the components {0, 1} and {2, 3}: a rejected registration led to another pose."""
    searched = {(1, 0): (1.0, 0.99), (2, 1): (1.0, 0.4), (2, 0): (-2.0, 0.1), (3, 2): (1.0, 0.99)}
    searched[3, 1] = (-2.0, 0.99)
    for contradicted, links in (((-4.0,), []), ((0.0,), [(1, 3)])):
        steps = steps_of(LooksAlike(searched=searched, contradicted=contradicted), 4)
        assert [step.component for step in steps] == [0, 0, 1, 1]
        assert [(link.i, link.j) for link in steps[3].links] == links
