"""Group axioms and conventions of rigid motions, as properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from tofuse.engine.errors import InputError
from tofuse.engine.geometry import quaternion, se3

finite = st.floats(-3, 3)
small = st.floats(-1.7, 1.7)  # keeps the rotation vector shorter than pi
twists = st.tuples(arrays(float, 3, elements=finite), arrays(float, 3, elements=small)).map(
    np.concatenate
)
tiny = st.tuples(
    arrays(float, 3, elements=finite), arrays(float, 3, elements=st.floats(-1e-3, 1e-3))
).map(np.concatenate)


def generator(xi: np.ndarray) -> np.ndarray:
    out = np.zeros((4, 4))
    out[:3, :3] = se3.hat(xi[3:])
    out[:3, 3] = xi[:3]
    return out


@given(st.one_of(twists, tiny))
def test_exp_is_matrix_exponential(xi: np.ndarray) -> None:
    np.testing.assert_allclose(se3.exp(xi), expm(generator(xi)), atol=1e-12)


@given(st.one_of(twists, tiny))
def test_log_inverts_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-10)


@given(twists, twists, twists)
def test_group_axioms(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    A, B, C = se3.exp(a), se3.exp(b), se3.exp(c)
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-12)
    np.testing.assert_allclose(A @ se3.inverse(A), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=1e-12)


@given(twists, twists)
def test_adjoint_converts_right_to_left_perturbation(a: np.ndarray, xi: np.ndarray) -> None:
    T = se3.exp(a)
    left = se3.exp(se3.adjoint(T) @ (1e-2 * xi))
    np.testing.assert_allclose(left @ T, T @ se3.exp(1e-2 * xi), atol=1e-11)


@given(twists, twists, st.floats(0, 1))
def test_interpolation_is_screw_motion(a: np.ndarray, b: np.ndarray, share: float) -> None:
    A, B = se3.exp(a), se3.exp(a) @ se3.exp(0.9 * b)
    np.testing.assert_allclose(se3.interpolate(A, B, 0.0), A, atol=1e-12)
    np.testing.assert_allclose(se3.interpolate(A, B, 1.0), B, atol=1e-9)
    middle = se3.interpolate(A, B, share)
    np.testing.assert_allclose(se3.log(se3.inverse(A) @ middle), share * 0.9 * b, atol=1e-9)


@given(arrays(float, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_log_and_angle_are_exact_near_pi(axis: np.ndarray) -> None:
    axis = axis / np.linalg.norm(axis)
    for angle in (np.pi, np.pi - 1e-9, np.pi - 1e-5):
        R = Rotation.from_rotvec(axis * angle).as_matrix()
        assert abs(se3.angle(R) - angle) < 1e-7
        np.testing.assert_allclose(se3.so3_exp(se3.so3_log(R)), R, atol=1e-9)
        T = se3.pose(R, [1, 2, 3])
        np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-7)


def test_motions_are_compared_by_length_and_angle() -> None:
    T = se3.exp(np.array([[0.3, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0.2, 0]]))
    np.testing.assert_allclose(se3.lengths(T), [[0.3, 0], [0, 0.2]], atol=1e-12)
    np.testing.assert_allclose(se3.change_of_view(T, [1.5, 9.0]), [0.2, 0.2], atol=1e-12)
    assert se3.change_of_view(T[0], 3.0) == pytest.approx(0.1)
    assert se3.is_within(T[0], 0.31, 0.0)
    assert not se3.is_within(T[0], 0.29, 0.1)
    assert se3.is_within(T[1], 0.0, 0.21)
    assert not se3.is_within(T[1], 0.1, 0.19)


def test_largest_sigmas_are_those_of_the_worst_directions() -> None:
    R = se3.so3_exp(np.array([0.3, -0.5, 0.2]))
    C = np.zeros((3, 6, 6))
    C[0, :3, :3] = R @ np.diag([1e-4, 9e-4, 4e-4]) @ R.T
    C[0, 3:, 3:] = np.diag([1e-6, 0, 0])
    C[2, :3] = np.nan  # a position that nothing measured
    expected = [[0.03, 0.001], [0, 0], [np.nan, 0]]
    np.testing.assert_allclose(se3.largest_sigmas(C), expected, atol=1e-12)


def test_functions_broadcast_over_stacks() -> None:
    xi = np.random.default_rng(0).normal(size=(4, 5, 6))
    T = se3.exp(xi)
    assert T.shape == (4, 5, 4, 4)
    np.testing.assert_array_equal(T[2, 3], se3.exp(xi[2, 3]))
    np.testing.assert_allclose(se3.log(se3.inverse(T))[1, 1], -se3.log(T)[1, 1], atol=1e-12)
    assert se3.adjoint(T).shape == (4, 5, 6, 6)


def test_transform_maps_points_from_b_to_a() -> None:
    T_a_b = se3.pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [10, 0, 0])
    np.testing.assert_allclose(
        se3.transform(T_a_b, [[1, 0, 0], [0, 2, 0]]), [[10, 1, 0], [8, 0, 0]]
    )


@given(twists, arrays(float, (3, 3), elements=st.floats(-1e-3, 1e-3)))
def test_orthonormalise_gives_nearest_rotation(xi: np.ndarray, noise: np.ndarray) -> None:
    T = se3.exp(xi)
    bent = T.copy()
    bent[:3, :3] += noise
    fixed = se3.orthonormalise(bent)
    np.testing.assert_allclose(fixed[:3, :3] @ fixed[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(fixed[:3, :3]) > 0
    to_fixed = np.linalg.norm(fixed[:3, :3] - bent[:3, :3])
    assert to_fixed <= np.linalg.norm(T[:3, :3] - bent[:3, :3]) + 1e-12


@given(twists)
def test_nearest_rotation_aligns_vectors(xi: np.ndarray) -> None:
    """Also vectors of a plane, which a reflection would align as well."""
    R = se3.exp(xi)[:3, :3]
    p = np.random.default_rng(0).normal(size=(6, 3)) * [1, 0.5, 0]
    np.testing.assert_allclose(se3.nearest_rotation(R @ p.T @ p), R, atol=1e-9)


@pytest.mark.parametrize(
    "change",
    [
        lambda T: T[:3],
        lambda T: T * np.nan,
        lambda T: T * 2,
        lambda T: T * 1e300,
        lambda T: T @ np.diag([1, 1, -1, 1]),
        lambda T: T + np.array([[0] * 4] * 3 + [[1, 0, 0, 0]]),
        lambda T: T + np.array([[0, 0, 0, 1e160]] + [[0] * 4] * 3),
    ],
)
def test_check_pose_rejects_non_rigid_matrices(change) -> None:
    T = se3.exp([1, 2, 3, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(se3.check_pose(T), T)
    with pytest.raises(InputError, match="pose"):
        se3.check_pose(change(T))


def test_transposed_poses_are_recognised() -> None:
    T = se3.exp([1, 2, 3, 0.1, 0.2, 0.3])
    with pytest.raises(InputError, match=r"given\[1\]: .*seems to be stored by columns"):
        se3.check_poses([np.eye(4), T.T], where="given")
    unknown = np.array(T)
    unknown[:3] = np.nan
    assert np.isnan(se3.check_poses([T, unknown], where="given")[1]).all()


unit_quaternions = (
    arrays(float, 4, elements=st.floats(-1, 1))
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)


@given(unit_quaternions, st.floats(0.1, 10))
def test_eq_2_11_and_2_12_agree_with_scipy(q: np.ndarray, scale: float) -> None:
    R = Rotation.from_quat(q).as_matrix()
    np.testing.assert_allclose(quaternion.to_matrix(scale * q), R, atol=1e-12)
    np.testing.assert_allclose(quaternion.unnormalised_matrix(scale * q), scale**2 * R, atol=1e-10)


@given(unit_quaternions)
def test_from_matrix_inverts_to_matrix(q: np.ndarray) -> None:
    back = quaternion.from_matrix(quaternion.to_matrix(q))
    assert back[3] >= 0
    np.testing.assert_allclose(back * np.sign(back @ q), q, atol=1e-12)


@given(unit_quaternions, unit_quaternions)
def test_quaternion_product_matches_matrix_product(a: np.ndarray, b: np.ndarray) -> None:
    A, B = quaternion.to_matrix(a), quaternion.to_matrix(b)
    np.testing.assert_allclose(quaternion.to_matrix(quaternion.multiply(a, b)), A @ B, atol=1e-12)
