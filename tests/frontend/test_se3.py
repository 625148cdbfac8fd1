"""Rigid motions against independent computations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from seamark.frontend import se3

vectors = st.lists(st.floats(-3, 3), min_size=3, max_size=3).map(np.array)


@given(vectors, vectors)
def test_inverse_and_adjoint_agree_with_matrix_algebra(w: np.ndarray, t: np.ndarray) -> None:
    T = se3.make(se3.exp_rotation(w), t)
    np.testing.assert_allclose(se3.inverse(T), np.linalg.inv(T), atol=1e-12)
    step = np.array([1e-6, -2e-6, 3e-6, 2e-6, 1e-6, -1e-6])
    small = se3.make(se3.exp_rotation(step[:3]), step[3:])
    moved = T @ small @ np.linalg.inv(T)
    seen = np.concatenate([[moved[2, 1], moved[0, 2], moved[1, 0]], moved[:3, 3]])
    np.testing.assert_allclose(seen, se3.adjoint(T) @ step, atol=2e-10)


@given(vectors)
def test_quaternion_and_logarithm_invert(w: np.ndarray) -> None:
    R = se3.exp_rotation(w)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    q = se3.to_quaternion(R)
    assert q[3] >= 0
    np.testing.assert_allclose(se3.from_quaternion(q), R, atol=1e-10)
    np.testing.assert_allclose(se3.exp_rotation(se3.log_rotation(R)), R, atol=1e-9)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turns_have_a_quaternion(axis: np.ndarray) -> None:
    R = se3.exp_rotation(np.pi * axis)
    np.testing.assert_allclose(se3.from_quaternion(se3.to_quaternion(R)), R, atol=1e-9)
    assert float(se3.rotation_angle(R)) == pytest.approx(np.pi, abs=1e-6)


def test_level_camera_looks_along_x() -> None:
    np.testing.assert_array_equal(se3.T_WORLD_LEVEL_CAM[:3, :3] @ [0, 0, 1], [1, 0, 0])
    np.testing.assert_array_equal(se3.T_WORLD_LEVEL_CAM[:3, :3] @ [0, -1, 0], [0, 0, 1])


def test_many_poses_are_made_orthonormal_like_one() -> None:
    T = np.stack(
        [se3.make(se3.exp_rotation(np.array([0.3, -1.2, 2.0]) * k), np.array([k, 2.0, 3.0])) for k in range(4)]
    )
    bent = T.copy()
    bent[:, :3, :3] += np.random.default_rng(0).normal(size=(4, 3, 3)) * 1e-4
    straight = se3.orthonormalise(bent)
    np.testing.assert_allclose(straight, T, atol=5e-4)
    np.testing.assert_allclose(
        straight[:, :3, :3] @ np.swapaxes(straight[:, :3, :3], 1, 2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-12
    )
    np.testing.assert_array_equal(straight, np.stack([se3.orthonormalise(one) for one in bent]))
    np.testing.assert_array_equal(straight[:, :3, 3], T[:, :3, 3])
