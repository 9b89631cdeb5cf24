"""Loop detection by appearance, after large drift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from made_rooms import at, seen
from pose_errors import assert_near
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.geometry import se3
from tofuse.engine.loops.appearance import Appearance
from tofuse.engine.loops.revisits import Revisits
from tofuse.engine.search.search_grid import SearchOptions
from tofuse.engine.stored_views.view_store import Spacing, ViewStore
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_descriptors import mutual_dissimilarity, view_descriptor
from tofuse.engine.views.view_planes import SurfaceOptions

CAMERA = Pinhole(96, 72, 78.0, 78.0, 47.5, 35.5)
ALL = Spacing(angle=0, distance=0)
QUICK = SearchOptions("full", full_candidates=15, photometric_candidates=5)
# Boxes (centre, half size, turned about y by rad) in a room of 5 x 2.4 x 4 m, y down.
BOXES = [
    ((1.3, 0.9, 1.2), (0.3, 0.5, 0.25), 0.3),
    ((-1.5, 0.6, 1.3), (0.2, 0.8, 0.3), 0.9),
    ((-1.2, 0.9, -1.3), (0.5, 0.4, 0.2), 1.2),
    ((1.6, 0.7, -0.9), (0.2, 0.6, 0.4), 0.1),
]


def room(yaw, index, *, half=(2.5, 1.2, 2.0), boxes=BOXES, spots=60):
    """Image of a camera in the middle of a room, rotated by `yaw`."""
    T = at(0, 0, yaw, pitch=0)
    return seen(T, index, half=half, boxes=boxes, spots=spots, camera=CAMERA, shaded=False)


def turning(count, step, **options):
    """Surfaces and true poses of a camera that rotates on the spot in increments of `step`."""
    xi = np.zeros((count, 6))
    xi[:, 4] = step * np.arange(count)
    views = [
        prepare_view(room(a, k, **options), SurfaceOptions(radii=(2,)))
        for k, a in enumerate(xi[:, 4])
    ]
    return views, se3.exp(xi)


def drifted(truth, degrees):
    """The same trajectory with additional rotation drift, far beyond its covariance."""
    T = [truth[0]]
    wrong = se3.exp(np.array([0, 0, 0, 0, np.radians(degrees) / (len(truth) - 1), 0]))
    for k in range(1, len(truth)):
        T.append(T[-1] @ se3.inverse(truth[k - 1]) @ truth[k] @ wrong)
    return np.stack(T)


def found_in(views, poses, appearance, sigma=0.0):
    store = ViewStore(ALL)
    loops = Revisits().start(0, (), store, QUICK, spacing=ALL, appearance=appearance)
    frame = room(0.0, 0)
    for view, T in zip(views, poses, strict=True):
        store.push(view, T)
        loops.push(replace(frame, index=view.index), T)
    half = len(poses) // 2  # the poses from here on have this uncertainty
    unsure = {k: sigma**2 * np.eye(6) * (k >= half) for k in range(len(poses))}
    return loops.finish(dict(enumerate(poses)), unsure)


@pytest.fixture(scope="module")
def full_turn():
    """A furnished room in steps of 20 degrees, once around and a little further."""
    return turning(20, np.radians(20.0))


def test_loop_is_closed_at_45_degrees_of_drift(full_turn):
    views, truth = full_turn
    poses = drifted(truth, 45)
    without_search = found_in(views, poses, Appearance(pairs=0))
    assert not any(c.record.accepted for c in without_search)
    closed = [c for c in found_in(views, poses, Appearance(pairs=2)) if c.record.accepted]
    assert closed
    for c in closed:
        assert c.record.j - c.record.i >= 16
        assert_near(c.T_i_j, se3.inverse(truth[c.record.i]) @ truth[c.record.j], 0.04, 1.5)
        assert "looks similar" in c.record.reason
        assert np.linalg.eigvalsh(c.information).min() > 0


def test_ambiguous_room_gives_no_false_loop():
    """Square and bare: all walls look alike, and a pose that fits is found."""
    views, truth = turning(12, np.radians(22.5), half=(2.0, 1.2, 2.0), boxes=[], spots=0)
    asked = found_in(views, truth, Appearance(pairs=2, min_difference=0.02))
    alike = [c for c in asked if "looks similar" in c.record.reason]
    assert len(alike) >= 2  # they do look similar
    assert sum("can't have drifted that far" in c.record.reason for c in alike) >= 2
    assert not any(c.record.accepted for c in asked)
    assert all(c.T_i_j is None for c in asked)


def test_loop_that_implies_implausible_drift_is_rejected(full_turn):
    """The same views, with a trajectory in which the camera hardly rotates."""
    views, truth = full_turn
    still = truth.copy()
    still[:] = se3.exp(np.linspace(0, 1, len(truth))[:, None] * np.array([0.1, 0, 0, 0, 3.0, 0]))
    appearance = Appearance(pairs=2)
    reasons = [c.record.reason for c in found_in(views, still, appearance) if not c.record.accepted]
    assert any("can't have drifted that far" in reason for reason in reasons)
    # Unless the stated uncertainty of the poses allows it.
    found = found_in(views, still, appearance, sigma=2.0)
    assert any(c.record.accepted and c.record.j - c.record.i >= 16 for c in found)


# Dissimilarity of views


def test_dissimilarity_matches_reference(full_turn):
    views, _ = full_turn
    descriptors = [view_descriptor(view) for view in views[:7]]
    descriptors[3][1] = np.nan  # a view without amplitude

    def slow(a, b, shift=0.25):
        best = 1.0
        for v in range(-round(shift * 9 / 2), round(shift * 9 / 2) + 1):
            for u in range(-round(shift * 12), round(shift * 12) + 1):
                pairs = [
                    (a[:, i, j], b[:, i - v, j - u])
                    for i in range(9)
                    for j in range(12)
                    if 0 <= i - v < 9 and 0 <= j - u < 12
                ]
                depth = [abs(y[0] - x[0]) / 0.3 for x, y in pairs]
                far = np.mean([min(d, 1) if np.isfinite(d) else 1 for d in depth])
                light = [y[1] - x[1] for x, y in pairs if np.isfinite(y[1] - x[1])]
                if len(light) > 0.2 * len(pairs):
                    off = np.abs(np.array(light) - np.mean(light)) / 0.5
                    far = 0.5 * (far + np.minimum(off, 1).mean())
                best = min(best, far)
        return best

    expected = [[min(slow(a, b), slow(b, a)) for b in descriptors] for a in descriptors]
    with threads(2):
        np.testing.assert_allclose(mutual_dissimilarity(descriptors, 0.25), expected, atol=1e-5)


def test_candidates_require_leaving_and_returning(full_turn):
    views, _truth = full_turn
    descriptors = [view_descriptor(view) for view in views]

    def candidates(
        descriptors, plausible=lambda i, j: True, closed=(), gain=lambda i, j: 0, **options
    ):
        return Appearance(**options).candidates(descriptors, plausible, closed, gain)

    pairs, refused = candidates(descriptors, pairs=10)
    assert (0, 18) in pairs
    assert (1, 19) in pairs
    assert all(j - i > 3 for i, j in pairs)
    assert refused == []
    assert candidates(descriptors, pairs=0) == ([], [])
    assert candidates(descriptors[:2]) == ([], [])
    # A static camera does not return, and known loops are not searched again.
    assert candidates([descriptors[0]] * 8) == ([], [])
    assert all(j < 16 or i > 3 for i, j in candidates(descriptors, closed=[(0, 18)], pairs=10)[0])
    assert len(candidates(descriptors, pairs=1)[0]) == 1
    # The one that adds most information comes first, then the most similar ones.
    assert candidates(descriptors, gain=lambda i, j: i, pairs=10)[0][0] == max(pairs)
    assert candidates(descriptors, gain=lambda i, j: 1, pairs=10)[0] == pairs
    # Pairs that the trajectory forbids do not count towards the limit.
    kept, refused = candidates(descriptors, lambda i, j: i > 0, pairs=1)
    assert kept == [(1, 19)]
    assert refused == [(0, 18)]


@pytest.mark.nightly
def test_candidates_of_many_views_are_found_by_index() -> None:
    """Past 300 places and back: too many views to compare all pairs."""
    rng = np.random.default_rng(4)
    places = rng.uniform(0.3, 1.0, (300, 2, 9, 12))
    views = np.concatenate([places, places[::-1]]) + rng.normal(0, 0.005, (600, 2, 9, 12))
    descriptors = list(views.astype(np.float32))
    pairs, refused = Appearance(pairs=40).candidates(descriptors, lambda i, j: True)
    assert len(pairs) == 40
    assert all(i + j == 599 for i, j in pairs)
    assert refused == []


def test_plausible_drift_grows_with_path_length():
    options = Appearance(drift=0.1)
    path = 4.0, 0.0  # m straight on
    assert options.plausible(se3.exp(np.array([0.3, 0, 0, 0, 0, 0])), *path, 2.0)
    assert not options.plausible(se3.exp(np.array([0.5, 0, 0, 0, 0, 0])), *path, 2.0)
    assert options.plausible(se3.exp(np.array([0, 0, 0, 0, 0.15, 0])), *path, 2.0)
    off = se3.exp(np.array([0, 0, 0, 0, 0.25, 0]))
    assert not options.plausible(off, *path, 2.0)
    assert options.plausible(off, *path, 2.0, tolerance=0.1)


def test_plausible_drift_grows_with_uncertainty() -> None:
    options = Appearance(drift=0.1)
    path = 4.0, 0.0  # m straight on
    along = se3.exp(np.array([1.0, 0, 0, 0, 0, 0]))
    C = np.diag([0.4**2, 0, 0, 0, 0, 0])
    assert not options.plausible(along, *path, 2.0)
    assert options.plausible(along, *path, 2.0, C)
    assert not options.plausible(se3.exp(np.array([0, 1.0, 0, 0, 0, 0])), *path, 2.0, C)
    assert not options.plausible(se3.exp(np.array([0, 0, 0, 0, 0.25, 0])), *path, 2.0, C)
