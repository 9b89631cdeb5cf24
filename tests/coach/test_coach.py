"""The coach: what views will see, what they would tell, and the words of the advice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import tofuse
from tofuse.apps.certainty.known import Known
from tofuse.apps.certainty.surfaces import Surfaces, pair_information, scales
from tofuse.apps.coach import advice as module
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Measured, build_graph, graph_covariances

FIELD = np.array([[-0.58, -0.43], [0.58, 0.43]])


def box_room(half: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Points on the six sides of a cube, and normals away from its middle."""
    a, b = (g.ravel() for g in np.meshgrid(*[np.arange(-half + 0.05, half, 0.1)] * 2))
    points, normals = [], []
    for axis in range(3):
        for sign in (-1, 1):
            side = np.full((len(a), 3), sign * half)
            side[:, (axis + 1) % 3], side[:, (axis + 2) % 3] = a, b
            points.append(side)
            normals.append(np.tile(sign * np.eye(3)[axis], (len(a), 1)))
    return np.concatenate(points).astype(np.float32), np.concatenate(normals).astype(np.float32)


def turned(degrees: float) -> np.ndarray:
    T = se3.exp([0, 0, 0, 0, np.radians(degrees), 0])
    T[:3, 3] = 0.3 * T[:3, 2]
    return T


def test_hidden_and_distant_surfaces_are_not_seen() -> None:
    points, normals = box_room()
    screen = points[normals[:, 2] > 0] * np.float32(0.5)
    ahead = np.tile(np.float32([0, 0, 1]), (len(screen), 1))
    both = np.concatenate([points, screen]), np.concatenate([normals, ahead])
    here = np.eye(4)[None]
    alone = Surfaces(points, normals, 5.0, FIELD).seen_from(here)
    front = points[alone.pixels[0] > 0]
    assert np.isclose(front[:, 2], 2).all(), "the walls beside are outside of the field"
    assert len(front) == pytest.approx(2 * 1.16 * 2 * 0.86 / 0.1**2, rel=0.1)
    with_screen = Surfaces(*both, 5.0, FIELD).seen_from(here)
    assert np.isclose(both[0][with_screen.pixels[0] > 0][:, 2], 1).all()
    assert not Surfaces(points, normals, 1.5, FIELD).seen_from(here).pixels.any()


def test_scales_are_those_of_the_measured_pairs() -> None:
    J = np.random.default_rng(2).normal(size=(9, 2, 8, 6))
    predicted = np.swapaxes(J, 2, 3) @ J
    measured = 300 * predicted[:, 0] + 20 * predicted[:, 1]
    measured[0] *= 50  # an outlier
    np.testing.assert_allclose(scales(measured, predicted), [300, 20], rtol=1e-3)
    # A kind that contradicts the measurements has no information, not a negative one.
    assert scales(predicted[:, 0], predicted[:, [1, 1]]).min() >= 0


def in_world(poses: np.ndarray) -> np.ndarray:
    """Motions of poses in the world by their right perturbations."""
    A = np.zeros((6 * len(poses), 6 * len(poses)))
    for k, T in enumerate(poses):
        A[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = se3.adjoint(T)
    return A


def known_turn(angles: list[float], weak: int = 0) -> tuple[Known, list[Measured]]:
    """Keyframes in the box room, each measured relative to the one before, one of them badly."""
    surfaces = Surfaces(*box_room(), 5.0, FIELD)
    poses = np.stack([turned(a) for a in angles])
    responses = surfaces.responses()
    seen = surfaces.seen_from(poses)
    edges = []
    for k in range(1, len(poses)):
        T = se3.inverse(poses[k - 1]) @ poses[k]
        information = np.diag([1e5] * 3 + [2e5] * 3) / (100 if k == weak else 1)
        edges.append(Measured(k - 1, k, T, information))
    graph = build_graph([*range(len(poses))], poses, edges)
    C = graph_covariances.GraphCovariances(graph).joint(np.arange(len(poses)))
    assert C is not None
    A, n = in_world(poses), len(poses)
    C = A @ C @ A.T
    known = Known(
        surfaces, responses, poses, np.arange(n)[::-1].astype(float), np.arange(n), np.zeros(3),
        seen, C, np.zeros(n, int), np.array([2e4, 2e3]), np.ones(n), 1.0, 0.01,
    )  # fmt: skip
    return known, edges


def test_predicted_fall_is_that_of_the_graph_with_the_views() -> None:
    """A way of two looks from the end of a turn to its beginning, as a graph that contains them."""
    known, edges = known_turn([0.0, 50, 100, 150, 200, 250, 300])
    looks = np.stack([turned(325), turned(345)])
    factor = known.factors(looks, [(0, 1)], (4.0, 2.0))[0]
    seen = known.surfaces.seen_from(looks)
    pairs = [(k, 7 + n) for n, k in np.argwhere(seen.overlap(known.seen) >= 0.3).tolist()]
    pairs.append((7, 8))
    assert {(6, 7), (0, 8)} < {*pairs}, "from what the end sees to what the beginning sees"
    poses = np.concatenate([known.poses, looks])
    every = known.surfaces.seen_from(poses)
    partners = np.append(known.partners, [sum(n in pair for pair in pairs) for n in (7, 8)])
    for i, j in pairs:
        kinds = pair_information(every.of([i]), every.of([j]), known.responses)[0]
        views = 4.0 if (i, j) != (7, 8) and j == 8 else 2.0
        H = np.einsum("k,kab->ab", known.scales, kinds) * views
        H /= 0.5 * (partners[i] + partners[j])
        A = se3.adjoint(poses[j])
        edges.append(Measured(i, j, se3.inverse(poses[i]) @ poses[j], A.T @ H @ A))
    graph = build_graph([*range(9)], poses, edges)
    C = graph_covariances.GraphCovariances(graph).joint(np.arange(7))
    assert C is not None
    A = in_world(known.poses)
    P = known._to_positions
    squares = [np.trace(P @ each @ P.T) for each in (known.covariance, A @ C @ A.T)]
    assert factor == pytest.approx(np.sqrt(squares[1] / squares[0]), rel=1e-4)
    assert factor < 0.95, "the loop is closed"
    # Another look at what the last two see closes no loop.
    assert known.factors(turned(280)[None], [(0,)], (4.0, 2.0))[0] > 0.95


def test_motion_without_a_bound_is_named() -> None:
    known, _ = known_turn([0.0, 40, 80, 120, 160, 200])
    assert not len(known.gaps)
    known = replace(known, parts=np.array([0, 0, 0, 1, 1, 1]))
    assert np.isinf(known.bound(known.covariance))
    advice = module.best(replace(known, bound_m=np.inf))
    assert advice.gaps == ((2, 3),)
    assert np.isinf(advice.bound_m)
    assert np.isinf(advice.expected_m)
    assert advice.gain_m == 0
    assert advice.words.endswith(" % less uncertain, but nothing bounds the motion 3 s ago")


def test_weakest_step_is_found() -> None:
    known, _ = known_turn([0.0, 40, 80, 120, 160], weak=2)
    assert np.argmax(known.step_squares) == 1
    assert known.step_squares[1] == pytest.approx(100 * known.step_squares[0], rel=0.3)


def test_advice_closes_the_loop() -> None:
    known, _ = known_turn([0.0, 50, 100, 150, 200, 250, 300])
    advice = module.best(known)
    assert advice.expected_m < advice.bound_m == 0.01
    assert advice.T_world_camera is not None
    # It looks between the two ends of the turn, or at the first keyframe.
    axis = advice.T_world_camera[:3, 2]
    assert np.degrees(np.arctan2(axis[0], axis[2])) == pytest.approx(-10, abs=45)
    assert "right" in advice.words
    assert advice.words.endswith(f"10 mm to {1e3 * advice.expected_m:.1f} mm")


@pytest.mark.parametrize(
    ("yaw", "pitch", "words"),
    [
        (90, 0, "turn 90\N{DEGREE SIGN} right"),
        (-31, 0, "turn 30\N{DEGREE SIGN} left"),
        (180, 0, "turn around"),
        (45, 35, "turn 40\N{DEGREE SIGN} right and look 40\N{DEGREE SIGN} up"),
        (0, -35, "look 40\N{DEGREE SIGN} down"),
    ],
)
def test_words_of_turns(yaw: float, pitch: float, words: str) -> None:
    assert module._turn(yaw, pitch) == words
    R = se3.exp([0, 0, 0, 0, np.radians(yaw), 0]) @ se3.exp([0, 0, 0, np.radians(pitch), 0, 0])
    if abs(yaw) < 90:
        np.testing.assert_allclose(module._direction(R[:3, 2]), (yaw, pitch), atol=1e-9)


def test_words_of_steps() -> None:
    assert module._way(np.array([0.1, 0.0, -2.0])) == "2.0 m back"
    assert module._way(np.array([-1.0, 0.0, 1.0])) in (
        "1.4 m left and ahead",
        "1.4 m ahead and left",
    )


def test_mapper_and_its_result_are_advised(room_recording) -> None:
    recording = tofuse.open(room_recording)
    mapper = tofuse.Mapper(threads=1)
    for k, frame in enumerate(recording):
        mapper.push(frame)
        if k == 0:
            assert tofuse.advise(mapper) is None
    live = tofuse.advise(mapper)
    result = mapper.finish()
    done = tofuse.advise(result)
    assert live is not None
    assert done is not None
    assert done.bound_m == result.diagnostics.accuracy.position_m
    # The bound before the end is that of the covariance, with all pairs that will be compared.
    noise = result.diagnostics.accuracy.causes_m["noise"]
    assert 0.5 * noise < live.bound_m < 10 * noise
    for said in (live, done):
        assert 0 < said.expected_m <= said.bound_m
        assert said.words


def test_words_of_times_and_of_the_same_view() -> None:
    assert [module._ago(s) for s in (0.21, 1.2, 75)] == ["0.2 s ago", "1 s ago", "75 s ago"]
    known, _ = known_turn([0.0, 40, 80, 120, 160, 200])
    assert module._way_to(known, 5, known.poses[5])[1] == "stay here"
    assert module._way_to(known, 0, known.poses[0])[1].startswith("go to where you were 5 s ago")
