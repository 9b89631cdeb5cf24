"""Intervals of lengths: what two points share makes them no less certain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import tofuse
from tofuse.apps.certainty import LengthErrors
from tofuse.apps.certainty.known import Known
from tofuse.engine.errors import InputError

# Three walls in front of the first, of both, and of the second of two cameras that look along z.
POINTS = np.float32([[-1, 0, 3], [0, 0, 3], [1, 0, 3]])
CAMERAS = np.float32([[-0.5, 0, 0, 0, 0, 1], [0.5, 0, 0, 0, 0, 1]])
SIGHTS = np.float32([[-1, 0, 6], [0, 0, 3], [0.5, 0, 3]])  # the first point's wall is oblique
SIGMA = 0.004  # of the second camera's position along x, m


def errors(**bounds: float) -> LengthErrors:
    C = np.zeros((12, 12), np.float32)
    C[6, 6] = SIGMA**2
    weights = np.uint8([[200, 0], [100, 100], [0, 50]])
    return LengthErrors(np.zeros(3), POINTS, weights, CAMERAS, SIGHTS, C, bounds)


@pytest.mark.parametrize(
    ("a", "b", "sigma"),
    [
        ((-1.2, 0, 3), (-0.9, 0, 3), 0.0),  # seen by the same camera
        ((1.0, 0.4, 3), (1.2, 0, 3), 0.0),
        ((-1.0, 0, 3), (1.0, 0, 3), SIGMA),  # each by another one
        ((-1.0, 0, 3), (0.0, 0, 3), SIGMA / 2),  # one of them by both
        ((-1.0, 0, 3), (1.0, 2.0, 3), SIGMA * np.sqrt(0.5)),  # half of it along the error
    ],
)
def test_poses_count_as_far_as_points_do_not_share_them(a, b, sigma) -> None:
    found = errors().between(a, b)
    assert found.length_m == pytest.approx(np.linalg.norm(np.subtract(a, b)))
    assert found.bound_m == pytest.approx(sigma, rel=1e-6, abs=1e-12)
    assert found.causes_m["poses"] == pytest.approx(found.bound_m)


def test_motion_of_all_cameras_changes_no_length() -> None:
    together = np.tile(np.eye(6, dtype=np.float32), (2, 2))
    one = errors()
    moved = replace(one, covariance=one.covariance + together)
    for b in ([0.1, 0.2, 2], [1, 2, 3]):
        expected = one.between([-1, 0, 3], b).bound_m
        assert moved.between([-1, 0, 3], b).bound_m == pytest.approx(expected, rel=1e-3)


def test_errors_of_the_camera_count_along_their_effect() -> None:
    across, ahead = ([-1.2, 0, 3], [-0.9, 0, 3]), ([-0.5, 0, 3], [-0.5, 0, 2.5])
    focal = errors(focal=0.01)
    assert focal.between(*across).bound_m == pytest.approx(0.01 * 0.3)
    assert focal.between(*ahead).bound_m == pytest.approx(0, abs=1e-9)
    apart = [-1.2, 0, 3], [1, 0, 3]
    assert focal.between(*apart).causes_m["focal"] == pytest.approx(0.01 * 2.2), "the poses follow"
    offset = errors(offset=0.01)
    assert offset.between(*ahead).bound_m == pytest.approx(0, abs=1e-9), "both ends move alike"
    scale = errors(scale=0.01, surface=0.003)
    assert scale.between(*ahead).bound_m == pytest.approx(np.hypot(0.005, 0.003))
    assert scale.between(*ahead).causes_m["surface"] == pytest.approx(0.003)
    by_both = scale.between([-1, 0, 3], [0, 0, 3]).causes_m["surface"]
    assert by_both == pytest.approx(0.003 * np.sqrt(0.75)), "the mean of two views is better"
    ranges = errors(range=0.01)
    assert ranges.between(*ahead).bound_m == pytest.approx(0.01 * np.hypot(6, 6))
    assert ranges.between(*apart).causes_m["range"] == pytest.approx(0.01 * np.hypot(1, 0.5))


def test_unbounded_poses_and_useless_points() -> None:
    one = errors()
    lost = replace(one, covariance=(one.covariance * 1e8).astype(np.float32))
    far = lost.between([-1, 0, 3], [1, 0, 3])
    assert far.bound_m == np.inf
    assert str(far) == "2000.0 mm, not bounded"
    near = lost.between([-1.2, 0, 3], [-0.9, 0, 3])
    assert str(near) == "300.0 ± 0.0 mm (95 %)"
    assert near.interval_m == pytest.approx((0.3, 0.3))
    for a, b in (([0, 0], [1, 1]), ([0, 0, 0], [0, 0, 0]), ([np.nan, 0, 0], [0, 0, 0])):
        with pytest.raises(InputError, match="two different points"):
            one.between(a, b)


def test_sights_are_lines_of_sight_over_the_cosine_to_the_normal(room_result) -> None:
    result = tofuse.load(room_result)
    known, found = Known.of_result(result, None), LengthErrors.of(result, None)
    seen = known.seen.pixels.any(0)
    once = np.flatnonzero((known.seen.pixels[:, seen] > 0).sum(0) == 1)
    assert len(once) > 10
    camera = known.poses[known.seen.pixels[:, seen][:, once].argmax(0), :3, 3]
    arm = known.surfaces.points[seen][once] - camera
    cosines = (arm * known.surfaces.normals[seen][once]).sum(1) / np.linalg.norm(arm, axis=1)
    np.testing.assert_allclose(found.sights[once], arm / cosines[:, None], rtol=1e-3, atol=1e-4)
