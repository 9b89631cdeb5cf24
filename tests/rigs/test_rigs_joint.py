"""All cameras of a rig at once: poses, depth offsets, and how sure they are.

The scene is made of planes that are rendered exactly, with noise: an open box that four cameras
look into from four sides.
"""

from functools import cache

import numpy as np

from rig_scene import looked_at
from tofuse.geometry import se3
from tofuse.lab.simulation.rig import around, relative
from tofuse.posegraph.view_store import KeptView
from tofuse.registration.prepared_view import SurfaceOptions, prepare_view
from tofuse.rigs.joint import View, disagreements, refine_together


def rig(seed: int, offset: float = 0.0) -> tuple[list[View], np.ndarray]:
    rng = np.random.default_rng([seed, 3])
    T = around((0, 0, 0.2), 1.3, 1.3, 4)
    views = [
        View(
            k,
            0,
            KeptView.of(
                prepare_view(looked_at(T[k], rng, offset if k == 2 else 0.0), SurfaceOptions()),
                4000,
            ),
        )
        for k in range(4)
    ]
    return views, np.stack(relative(T))


def disturbed(poses: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng([seed, 4])
    scale = np.array([0.01] * 3 + [np.radians(0.5)] * 3)
    away = rng.normal(size=(len(poses), 6)) * scale
    away[0] = 0
    return poses @ se3.exp(away)


@cache
def found(seed: int):
    views, truth = rig(seed)
    return refine_together(views, disturbed(truth, seed)), truth


def test_cameras_end_where_they_are() -> None:
    placed, truth = found(0)
    off = se3.inverse(placed.poses) @ truth
    assert np.array_equal(placed.poses[0], np.eye(4))
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.004
    assert np.degrees(se3.angle(off)).max() < 0.15


def test_covariance_is_of_the_size_of_the_errors() -> None:
    squares = []
    for seed in range(6):
        placed, truth = found(seed)
        for k in range(1, 4):
            e = se3.log(se3.inverse(placed.poses[k]) @ truth[k])
            squares.append(e @ np.linalg.solve(placed.covariance[k][:6, :6], e))
    # Chi-square with 6 degrees of freedom has the median 5.3.
    assert 1.5 < np.median(squares) < 12.0


def test_the_depth_offset_of_one_camera_is_found() -> None:
    views, truth = rig(1, offset=0.008)
    placed = refine_together(views, disturbed(truth, 1))
    sigma = np.sqrt(placed.covariance[2][6, 6])
    assert abs(-placed.offsets[2] - 0.008) < max(3 * sigma, 0.002)
    assert sigma < 0.005


def test_surfaces_disagree_more_where_a_camera_is_wrong() -> None:
    views, truth = rig(2)
    right = disagreements(views, truth)
    wrong = truth.copy()
    wrong[3, :3, 3] += [0.0, 0.0, 0.02]
    moved = disagreements(views, wrong)
    assert right[0, 1][0] < 0.003
    assert moved[2, 3][0] > 2 * right[2, 3][0]
    assert moved[0, 1] == right[0, 1]


def test_cameras_that_share_nothing_are_not_known() -> None:
    views, truth = rig(3)
    apart = [v for v in views if v.camera in (0, 1)]
    apart = [apart[0], View(1, 1, apart[1].kept)]  # at another instant
    placed = refine_together(apart, truth[:2])
    assert np.allclose(placed.poses, truth[:2])
    assert not placed.disagreement
