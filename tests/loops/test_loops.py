"""Loop closure: candidates, and their verification (section 3.4)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from tofuse.engine.alignment.base import Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp import algorithm_1
from tofuse.engine.loops.loops import Confirmation, PriorLoop, mean_error
from tofuse.engine.loops.nearby import Nearby, yaw
from tofuse.engine.stored_views.view_store import Spacing, ViewStore
from tofuse.lab.simulation.peaks import peaks_views


def pose(x: float = 0.0, z: float = 0.0, *, heading: float = 0.0, pitch: float = 0.0) -> Float64:
    """Camera at (x, 0, z), rotated about its y axis, then about its x axis."""
    T = se3.exp([0, 0, 0, 0, heading, 0]) @ se3.exp([0, 0, 0, pitch, 0, 0])
    T[:3, 3] = [x, 0, z]
    return T


def turning(n: int) -> Float64:
    """A camera that rotates once on the spot, and n / 4 frames more."""
    return np.array([pose(heading=2 * np.pi * k / n) for k in range(n + n // 4)])


def test_yaw_is_rotation_about_camera_y_axis():
    angles = np.linspace(-3, 3, 13)
    measured = [yaw(pose(heading=a, pitch=0.4)) for a in angles]
    np.testing.assert_allclose(measured, angles, atol=1e-12)
    np.testing.assert_allclose(yaw(se3.exp([1, 2, 3, 0, 0, 0.7])), 0, atol=1e-12)


def test_candidates_are_near_similar_in_heading_and_not_recent():
    poses = np.array(
        [
            pose(0.0),  # 0: too far
            pose(2.0, heading=1.0),  # 1: looks elsewhere
            pose(2.1, heading=0.2),  # 2: candidate, second best
            pose(2.0, heading=-0.1),  # 3: candidate, best
            pose(2.45, heading=0.25),  # 4: candidate, last
            np.full((4, 4), np.nan),  # 5: lost
            pose(2.0),  # 6: too recent
            pose(2.0),  # 7: too recent
            pose(2.0),  # 8: the newest
        ]
    )
    detector = Nearby(max_distance_m=0.5, max_yaw_rad=0.3, min_gap=3, per_frame=9)
    assert detector.candidates(poses).tolist() == [3, 2, 4]
    assert replace(detector, per_frame=2).candidates(poses).tolist() == [3, 2]
    assert replace(detector, per_frame=0).candidates(poses).tolist() == []
    assert replace(detector, min_gap=2).candidates(poses).tolist() == [6, 3, 2, 4]
    assert replace(detector, min_gap=9).candidates(poses).tolist() == []
    assert detector.candidates(poses[:1]).tolist() == []


@dataclass(frozen=True)
class Scripted:
    """A registrar with scripted results that depend on the error of the guess."""

    truth: Float64
    reach: float = 1.0
    share: float = 0.6
    error: float = 0.2
    calls: list[Float64] = field(default_factory=list)
    draws: list[float] = field(default_factory=list)
    takes = frozenset({"cloud", "range"})

    def register(self, source, target, guess, rng):
        self.calls.append(guess)
        self.draws.append(rng.random())
        away = np.linalg.norm(se3.log(se3.inverse(self.truth) @ guess))
        if away > 5:
            raise RegistrationError("no points correspond", where=f"frame {source.index}")
        near = away <= self.reach
        share = self.share if near else 0.1
        T = self.truth if near else guess
        error = self.error * share
        return Registration(T, True, 5, int(100 * share), 100, error, 0.01, np.eye(6) * 7)


def view(index: int) -> CloudFrame:
    return CloudFrame(index, float(index), np.zeros((5, 3), np.float32))


@pytest.mark.parametrize(
    ("registrar", "reason"),
    [
        (Scripted(np.eye(4), share=0.2), "only 20 % of the points correspond, 30 % are needed"),
        (Scripted(np.eye(4), error=0.9), "the error is 0.90 of the resolution, above 0.65"),
        (Scripted(np.eye(4), share=0.0), "only 0 % of the points correspond, 30 % are needed"),
        (Scripted(pose(20.0)), "not registered: frame 9: no points correspond"),
    ],
)
def test_bad_fit_is_rejected_with_reason(registrar, reason):
    closed = Confirmation((registrar,)).confirm(view(9), view(2), np.eye(4), seed=0)
    assert not closed.record.accepted
    assert closed.record.reason == reason
    assert closed.T_i_j is None
    assert closed.information is None


def test_fewer_correspondences_do_not_improve_the_error():
    """E falls when points lose their partners; the mean error does not."""
    many = Registration(np.eye(4), True, 1, 80, 100, 0.8 * 0.7, 0.1, np.eye(6))
    few = replace(many, correspondences=40, error=0.4 * 0.7)
    assert few.error < many.error
    assert mean_error(few) == pytest.approx(mean_error(many)) == pytest.approx(0.7)
    assert Confirmation().rejection_reason(few)
    assert Confirmation().rejection_reason(many)


def test_better_of_guess_and_identity_is_used():
    near_identity = pose(0.2)
    drifted = pose(3.0)
    registrar = Scripted(near_identity)
    assert Confirmation((registrar,)).confirm(view(9), view(2), drifted, seed=0).record.accepted
    np.testing.assert_array_equal(registrar.calls[0], drifted)
    np.testing.assert_array_equal(registrar.calls[1], np.eye(4))
    far = pose(3.0)
    registrar = Scripted(far)
    assert Confirmation((registrar,)).confirm(view(9), view(2), far, seed=0).record.accepted


def test_registrations_are_chained_and_seeded():
    truth = pose(0.8)
    coarse, fine = Scripted(truth, reach=2.0), Scripted(truth, reach=0.1)
    first = Confirmation((coarse, fine)).confirm(view(9), view(2), np.eye(4), seed=0)
    assert first.record.accepted
    np.testing.assert_array_equal(fine.calls[0], truth)
    draws = list(coarse.draws)
    Confirmation((coarse, fine)).confirm(view(9), view(2), np.eye(4), seed=0)
    assert coarse.draws == draws * 2
    Confirmation((coarse, fine)).confirm(view(9), view(2), np.eye(4), seed=1)
    assert coarse.draws[-1] != draws[-1]


def test_candidates_are_recorded_and_given_loops_used():
    poses = turning(20)
    confirmation = Confirmation((Scripted(se3.inverse(poses[0]) @ poses[20]),))
    by_hand = pose(0.05)
    given = [PriorLoop(0, 20, by_hand), PriorLoop(5, 21), PriorLoop(3, 17)]
    loops = Nearby(max_yaw_rad=0.01, min_gap=8, confirmation=confirmation)
    loops = loops.start(0, given, ViewStore(Spacing()))
    for k in range(22):
        if k != 5:  # lost
            loops.push(view(k), poses[k])
    closed = loops.finish({k: poses[k] for k in range(22) if k != 5}, {})
    pairs = {(c.record.i, c.record.j): c for c in closed}
    assert list(pairs) == [(3, 17), (0, 20), (1, 21), (5, 21)]
    np.testing.assert_array_equal(pairs[0, 20].T_i_j, by_hand)
    assert pairs[0, 20].record.reason == "given with its motion"
    assert np.linalg.eigvalsh(pairs[0, 20].information).min() > 0
    assert pairs[1, 21].record.accepted
    assert pairs[5, 21].record == replace(pairs[5, 21].record, accepted=False)
    assert pairs[5, 21].record.reason == "frame 5 has no pose"
    # Given without its motion: registered starting from the trajectory.
    starts = confirmation.registrations[0].calls
    assert any(np.allclose(s, se3.inverse(poses[3]) @ poses[17]) for s in starts)


def test_real_registrations_distinguish_loop_from_other_place():
    """Views 0 and 1 of the synthetic case overlap; views 0 and 10 see opposite sides."""
    views, truth = peaks_views(0.02, 0)
    confirmation = Confirmation((algorithm_1(1.0), algorithm_1(0.25)), min_fraction=0.4)
    near = confirmation.confirm(views[1], views[0], np.eye(4), seed=0)
    assert near.record.accepted
    away = se3.log(se3.inverse(truth[1]) @ near.T_i_j)
    assert np.linalg.norm(away[:3]) < 0.5
    assert np.linalg.norm(away[3:]) < 0.05
    assert not confirmation.confirm(views[10], views[0], truth[10], seed=0).record.accepted
