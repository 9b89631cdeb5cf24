"""``tofuse.register`` on two range images without a guess, and acceptance of the pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import tofuse
from made_rooms import BOXES, CAMERA, OTHER, at, seen, surface
from pose_errors import pose_error
from ray_casting import rays_at, to_plane
from tofuse.engine.alignment.base import PROBABLE
from tofuse.engine.alignment.projective import ProjectiveOptions, Target, align
from tofuse.engine.cameras.cameras import RayTable
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.search.pair_agreement import Agreement, agreement
from tofuse.engine.search.pose_probability import ACCEPTED, PoseEvidence
from tofuse.engine.search.verification import FitStatistics
from tofuse.engine.search.view_pair import follow, register_pair
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions

# 40 degrees and 0.5 m apart.
A, B = at(-0.4, 0.3, 0.1), at(-0.1, 0.7, 0.8)
TRUE = se3.inverse(A) @ B


@pytest.fixture(scope="module")
def pair():
    """Source and target."""
    return seen(B, 1), seen(A, 0)


@pytest.fixture(scope="module")
def far(pair):
    return tofuse.register(*pair)


def test_distant_pair_is_found_and_accepted(far):
    metres, degrees = pose_error(far.T_target_source, TRUE)
    assert metres < 0.02
    assert degrees < 0.5
    assert far.believed
    assert far.probability >= ACCEPTED
    assert far.reason == ""
    assert far.margin > 0.1
    assert 0.2 < far.support <= far.overlap < 1
    assert far.contradiction < 0.05
    assert np.linalg.eigvalsh(far.information).min() > 0


def falling(frame: RangeFrame, exponent: float) -> RangeFrame:
    """With raw amplitude, which falls off towards the corners."""
    x, y = np.moveaxis(frame.camera.rays(), -1, 0)
    length2 = 1 + x * x + y * y
    shade = length2 ** (-exponent / 2) / (length2 * np.maximum(frame.z, 1e-3) ** 2)
    light = (frame.amplitude_image * shade).astype(np.float32)
    return replace(frame, amplitude_image=light, amplitude_kind="raw")


@pytest.mark.parametrize("exponent", [0.0, 8.0])
def test_amplitude_falloff_is_estimated(pair, far, exponent):
    """A pattern that is fixed to the camera neither biases the pose nor contradicts it."""
    views = [surface(falling(frame, exponent)) for frame in pair]
    found = agreement(*views, TRUE)
    assert found.falloff == pytest.approx(exponent, abs=0.5)
    options = SurfaceOptions(radii=(2,), falloff=exponent)
    known = agreement(*(prepare_view(falling(frame, exponent), options) for frame in pair), TRUE)
    assert known.falloff == 0
    assert found.support == pytest.approx(known.support, abs=0.005)
    assert found.score == pytest.approx(known.score, abs=0.01)
    found = tofuse.register(*(falling(frame, exponent) for frame in pair))
    metres, degrees = pose_error(found.T_target_source, far.T_target_source)
    assert metres < 0.01
    assert degrees < 0.2


def test_covariance_covers_error(far):
    gap = se3.log(se3.inverse(far.T_target_source) @ TRUE)
    assert gap @ far.information @ gap < 22.5  # 99.9 % of a chi square of six dimensions


@pytest.mark.nightly
@pytest.mark.parametrize("quarters", [1, 2])
def test_camera_on_its_side_is_found(quarters):
    # Outside the exhaustive search, whose poses are upright.
    image = seen(at(-0.3, 0.4, 0.4), 1)
    turn = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), quarters)
    rays = np.rot90(image.camera.rays() @ turn.T.astype(np.float32), -quarters)
    assert image.amplitude_image is not None
    source = replace(
        image,
        camera=RayTable(rays),
        depth=np.rot90(image.depth, -quarters),
        amplitude_image=np.rot90(image.amplitude_image, -quarters),
        sigma_image=None,
    )
    roll = np.eye(4)
    roll[:2, :2] = turn
    found = tofuse.register(source, seen(A, 0))
    metres, degrees = pose_error(found.T_target_source @ roll, se3.inverse(A) @ at(-0.3, 0.4, 0.4))
    assert metres < 0.02
    assert degrees < 0.5
    assert found.believed


@pytest.mark.nightly_part
def test_views_of_different_rooms_are_rejected(pair):
    for k, boxes in enumerate((OTHER, BOXES)):
        half = (3.4, 1.6, 2.9)
        other = seen(at(0.8, -1.0, 2.4 + k), 7, half=half, boxes=boxes, scene=11 + k)
        found = tofuse.register(other, pair[1])
        assert not found.believed
        assert found.probability < ACCEPTED
        assert found.reason


def wall(T_world_camera, index, noise=0.004):
    """A flat wall of one albedo, 2 m ahead."""
    z = to_plane(*rays_at(T_world_camera, CAMERA), np.array([0, 0, 1]), 2)
    z += np.random.default_rng(index).normal(0, noise, z.shape)
    return RangeFrame(index, 0.0, CAMERA, z.astype(np.float32))


def test_degenerate_directions_stay_as_guessed():
    T = se3.exp([0.3, 0.1, 0.1, 0.05, 0.15, 0.02])
    guess = T @ se3.exp([0, 0, 0.04, 0.02, 0.02, 0])
    found = tofuse.register(wall(T, 1), wall(np.eye(4), 0), guess=guess)
    assert len(found.unobservable) == 3
    assert not found.believed
    # The distance to the wall is found; along the wall the pose stays as guessed.
    gap = found.T_target_source @ se3.inverse(T)
    normal_error = gap[2, 3] + (gap[2, :3] - [0, 0, 1]) @ [0, 0, 2]
    assert abs(normal_error) < 0.003
    assert np.linalg.norm((se3.inverse(guess) @ found.T_target_source)[:2, 3]) < 0.05


def test_repetitive_room_is_ambiguous():
    # Posts at equal distances along a wall, from two places one and a half spacings apart.
    posts = tuple(((0.6 * k, 0.2, 1.6), (0.1, 0.9, 0.1), 0.0) for k in range(-12, 13))
    room = {"half": (9.0, 1.1, 1.8), "boxes": posts, "spots": 0}
    source, target = (seen(at(x, -0.6, 0.0), k, **room) for k, x in enumerate((0.3, -0.6)))
    found = tofuse.register(source, target)
    assert not found.believed
    assert found.margin < 0.1
    metres, degrees = pose_error(found.runner_up, found.T_target_source)
    assert metres > 0.05 or degrees > 4.9
    assert "another pose fits nearly as well" in found.reason


def test_good_guess_is_used_without_search(pair):
    near = seen(A @ se3.exp([0.1, 0.02, -0.05, 0.02, 0.1, 0.0]), 2)
    true = se3.exp([0.1, 0.02, -0.05, 0.02, 0.1, 0.0])
    found = tofuse.register(near, pair[1], guess=true @ se3.exp([0.02, 0, 0.02, 0, 0.03, 0]))
    assert found.margin is None  # no rival was evaluated
    assert found.believed
    assert pose_error(found.T_target_source, true)[0] < 0.01


def test_wrong_guess_is_not_trusted(pair, far):
    for wrong in ([0.8, 0, -0.5, 0, 0.6, 0], [0, 0.6, 0, 0.4, 0, 0.3]):
        found = tofuse.register(*pair, guess=se3.exp(wrong))
        assert found.believed
        assert pose_error(found.T_target_source, far.T_target_source)[0] < 0.02


def test_small_scene_is_registered_like_large_one(pair, far):
    small = [replace(f, depth=f.depth * np.float32(0.25)) for f in pair]
    found = tofuse.register(*small)
    assert found.believed
    gap = se3.inverse(far.T_target_source) @ found.T_target_source
    np.testing.assert_allclose(
        found.T_target_source[:3, 3], 0.25 * far.T_target_source[:3, 3], atol=0.01
    )
    assert np.degrees(se3.angle(gap)) < 1


def test_views_of_different_scale_are_refused(pair):
    large = replace(pair[0], depth=pair[0].depth * np.float32(1000))
    with pytest.raises(tofuse.RegistrationError, match="frame 1: has a median depth of"):
        tofuse.register(large, pair[1])


def test_constant_depths_are_rejected(pair):
    flat = replace(pair[0], depth=np.full_like(pair[0].depth, 1.5), amplitude_image=None)
    for views in ((flat, flat), (flat, pair[1])):
        found = tofuse.register(*views)
        assert not found.believed
        assert found.reason


def agreement_of(support, contradiction, overlap=0.6):
    return Agreement(overlap, support, contradiction * overlap, 0.0, 0.01, 1000, support)


def test_probability_follows_evidence():
    good = PoseEvidence.of(agreement_of(0.5, 0.0), 0.3)
    assert good.probability > 0.95
    for worse in (
        PoseEvidence.of(agreement_of(0.5, 0.2), 0.3),
        PoseEvidence.of(agreement_of(0.5, 0.0), 0.02),
    ):
        assert worse.probability < good.probability
    assert (
        PoseEvidence.of(agreement_of(0.5, 0.0), -0.1).probability
        == PoseEvidence.of(agreement_of(0.5, 0.0), 0.0).probability
    )
    # Support is part of the margin; where no rival was evaluated, it counts by itself.
    assert (
        PoseEvidence.of(agreement_of(0.9, 0.0)).probability
        > 0.98
        > PoseEvidence.of(agreement_of(0.3, 0.0)).probability
    )
    assert (
        PoseEvidence.of(agreement_of(0.9, 0.1)).probability
        < PoseEvidence.of(agreement_of(0.9, 0.0)).probability
    )


def test_usual_fit_of_camera_decides_acceptance(pair):
    """The same view, but with a box in front of the camera."""
    box = ((0.0, 0.2, 1.05), (0.35, 0.4, 0.1), 0.0)
    target, near = surface(pair[1]), A @ se3.exp([0.02, 0, 0, 0, 0.02, 0])
    plain, blocked = (surface(seen(near, 8, boxes=b)) for b in (BOXES, (*BOXES, box)))
    fit_statistics = FitStatistics()
    for _ in range(20):
        aligned = align(target, [Target(plain, np.eye(4))], np.eye(4), ProjectiveOptions())
        fit_statistics.learn(aligned, target.depth)
    assert follow(plain, target, np.eye(4), fit_statistics=fit_statistics) is not None
    assert follow(blocked, target, np.eye(4), fit_statistics=fit_statistics) is None


def test_alignment_is_accepted_if_consistent_in_both_directions(pair):
    true = se3.exp([0.08, 0, 0.05, 0, 0.1, 0])
    target, source = surface(pair[1]), surface(seen(A @ true, 8))
    found = follow(source, target, np.eye(4))
    assert found.margin is None  # no rival was evaluated
    assert pose_error(found.T_target_source, true)[0] < 0.01
    back = follow(target, source, np.eye(4))
    assert pose_error(back.T_target_source, se3.inverse(true))[0] < 0.01
    # From a distant start nothing is found, rather than a wrong pose.
    off = follow(source, target, se3.exp([0.5, 0.2, 0.6, 0.2, 1.2, 0]))
    assert off is None or pose_error(off.T_target_source, true)[0] < 0.02


def test_large_margin_outweighs_degenerate_directions():
    """Otherwise poses along them would fit as well."""
    for margin in (0.02, 0.05):
        supported, unsupported = (PoseEvidence(0.6, 0.0, margin, k).probability for k in (0, 1))
        assert unsupported < supported
    assert PoseEvidence(0.6, 0.0, 0.2, 1).probability == PoseEvidence(0.6, 0.0, 0.2).probability


def test_largest_overlap_along_wall_is_no_evidence():
    """Any place along it fits; the one where the views overlap entirely has the most points."""
    views = []
    for k, x in enumerate((0.0, 0.2)):
        frame = seen(at(x, 1.0, 0.0, pitch=0.0), k, boxes=(), spots=0)
        views.append(surface(replace(frame, amplitude_image=None)))
    found = register_pair(views[1], views[0])
    assert found.probability < PROBABLE
    assert "degenerate" in found.reason


def test_consistent_search_and_alignment_stand_alone(pair):
    target = surface(pair[1])
    near, far = (
        register_pair(surface(seen(A @ se3.exp(xi), 8)), target, always_search=True)
        for xi in ([0.05, 0, 0, 0, 0.08, 0], [0.3, 0, 0.3, 0, 0.75, 0])
    )
    assert near.confirmed
    assert near.margin is not None
    assert not far.confirmed
    for confirmed, probability, alone in (
        (True, 0.6, True),
        (False, 0.6, False),
        (True, 0.4, False),
    ):
        made = replace(near, believed=False, confirmed=confirmed, probability=probability)
        assert made.is_decisive == alone
