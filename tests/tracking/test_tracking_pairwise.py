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
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3)).astype(np.float32)
    steps = [tracker.push(CloudFrame(k, float(k), points)) for k in range(len(motions))]
    assert all(step.status == "tracked" for step in steps)
    # While all directions are constrained, the last motion is extrapolated.
    np.testing.assert_allclose(method.guesses[2:9], 0.1, atol=1e-9)
    np.testing.assert_allclose(method.guesses[9], 0.13, atol=1e-9)
    # From the second one on the mean, in which the last motion has a weight of 30 %.
    assert all(0.1 < guess < 0.12 for guess in method.guesses[11:])


def test_interruption_resets_predicted_motion() -> None:
    method = Scripted(motions=(0.0, 0.1, 0.1, 0.1))
    tracker = Pairwise(registration=method).start(0)
    points = np.zeros((40, 3), np.float32)
    for k in (0, 1, 2):
        tracker.push(CloudFrame(k, float(k), points))
    tracker.interrupt()
    tracker.push(CloudFrame(3, 3.0, points))
    np.testing.assert_allclose(method.guesses, [0.0, 0.1, 0.0], atol=1e-9)
