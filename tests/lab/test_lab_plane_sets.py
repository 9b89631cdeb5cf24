"""Registration by the planes of two images, and their unobservable directions."""

from __future__ import annotations

import numpy as np

import tofuse
from pose_errors import pose_error
from searched_pair import TRUE, A, B, seen
from tofuse.engine.geometry import se3
from tofuse.engine.search.plane_detection import detect_planes
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.lab.methods.plane_sets import PlaneSets

WORLD = [((0, 1, 0), 1.0), ((0.1, 0, 1), 3.8), ((1, 0, -0.2), 1.7)]


def in_view(T_world_camera):
    """(3, 4) normals and offsets of the floor and the walls of the scene."""
    out = []
    for normal, offset in WORLD:
        length = np.linalg.norm(normal)
        n = np.array(normal) / length
        out.append([*(n @ T_world_camera[:3, :3]), offset / length - n @ T_world_camera[:3, 3]])
    return np.array(out)


def test_detected_planes_match_scene():
    view = prepare_view(seen(A, seed=1), SurfaceOptions())
    found = detect_planes(view, np.random.default_rng(0))
    assert len(found) >= 3
    assert [p.fraction for p in found[:3]] == sorted((p.fraction for p in found[:3]), reverse=True)
    planes = np.array([[*p.normal, p.offset] for p in found])
    for *normal, offset in in_view(A)[:2]:  # the other wall is barely in view
        angle = np.degrees(np.arccos(np.clip(planes[:, :3] @ normal, -1, 1)))
        k = int(np.argmin(angle))
        assert angle[k] < 1.0
        assert abs(planes[k, 3] - offset) < 0.01
    assert all(p.rms_m < 0.02 for p in found)


def test_furnished_corner_is_registered_without_guess():
    found = tofuse.register(seen(B, seed=1), seen(A, seed=2), method=PlaneSets())
    shift, angle = pose_error(found.T_target_source, TRUE)
    assert shift < 0.05
    assert angle < 1.5
    assert found.correspondences >= 3
    assert len(found.unobservable) == 0
    assert found.margin > 0.1
    assert np.linalg.eigvalsh(found.information).min() > 0


def test_single_floor_is_degenerate_in_three_directions():
    source, target = (seen(T, boxes=[], walls=False, seed=k) for k, T in ((1, B), (2, A)))
    guess = TRUE @ se3.exp(np.array([0.1, 0.05, -0.1, 0.05, 0.1, -0.05]))
    found = tofuse.register(source, target, guess=guess, method=PlaneSets())
    floor = in_view(B)[0]
    turned = found.T_target_source[:3, :3] @ floor[:3]
    assert np.degrees(np.arccos(np.clip(turned @ in_view(A)[0, :3], -1, 1))) < 0.7
    offset = floor[3] + turned @ found.T_target_source[:3, 3]
    assert abs(offset - in_view(A)[0, 3]) < 0.01
    assert found.unobservable.shape == (3, 6)
    # Translation along the floor, and rotation about its normal.
    basis = np.zeros((3, 6))
    basis[0, 3:] = floor[:3]
    basis[1:, :3] = np.linalg.svd(floor[None, :3])[2][1:]
    np.testing.assert_allclose(np.abs(np.linalg.det(found.unobservable @ basis.T)), 1, atol=0.02)
    # These follow the guess.
    along = basis[1:, :3] @ (se3.inverse(guess) @ found.T_target_source)[:3, 3]
    assert np.abs(along).max() < 0.03
    gap = se3.log(se3.inverse(guess) @ found.T_target_source)
    assert abs(gap[3:] @ floor[:3]) < 0.02
