"""The C++ kernels against the same algorithms in numpy, which follow the papers line by line and take 3 to 40 times as
long.
"""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from seamark.frontend import se3
from seamark.frontend.camera import Camera
from seamark.frontend.depth_offset import DepthOffset
from seamark.frontend.kernels import native
from seamark.frontend.patches import align_along, align_warped
from seamark.frontend.pose import Prediction, converge
from seamark.frontend.pyramid import Pyramid, pyramid_of
from seamark.frontend.residuals import Observations, residuals_and_jacobian, shift_of_distance
from seamark.frontend.window import INITIAL_DAMPING, RELATIVE_DECREASE, BundleProblem, adjust

CAMERA = Camera(640, 480, 420, 410, 322, 238)
HUBER = 1.345
Array = NDArray[np.float64]


# --- patches -----------------------------------------------------------------------------------------------------

DY, DX = (v.ravel().astype(np.float32) for v in np.mgrid[-7:8, -7:8])
WINDOW = np.exp(-(DX**2 + DY**2) / (2 * 4.4**2)).astype(np.float32)
WINDOW /= WINDOW.sum()


def sample(image: Array, x: Array, y: Array) -> Array:
    x, y = np.ascontiguousarray(x, np.float32), np.ascontiguousarray(y, np.float32)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def patches(image: Array, centres: Array) -> Array:
    return centred(sample(image, centres[:, :1] + DX, centres[:, 1:] + DY))


def centred(values: Array) -> Array:
    return values - (values @ WINDOW)[:, None]


def slopes(grey: NDArray[np.uint8]) -> tuple[Array, Array, Array]:
    image = grey.astype(np.float32)
    across = cv2.Scharr(image, cv2.CV_32F, 1, 0, scale=1 / 32)
    down = cv2.Scharr(image, cv2.CV_32F, 0, 1, scale=1 / 32)
    return image, across, down


def likeness(seen: Array, template: Array) -> Array:
    return ((seen * template) @ WINDOW) / np.sqrt(np.maximum((seen**2 @ WINDOW) * (template**2 @ WINDOW), 1e-6))


def along_in_numpy(left: Array, right: Array, points: Array, start: Array, along: Array) -> tuple[Array, Array]:
    image, across, down = slopes(right)
    there, template = start.astype(np.float32), patches(left.astype(np.float32), points)
    for _ in range(6):
        slope = patches(across, there) * along[:, :1] + patches(down, there) * along[:, 1:]
        pull = (slope * (patches(image, there) - template)) @ WINDOW
        step = -pull / np.maximum((slope**2) @ WINDOW, 1e-3)
        there = there + np.clip(step, -1, 1)[:, None] * along
    return there, likeness(patches(image, there), template)


def warped_in_numpy(reference: Array, grey: Array, points: Array, start: Array, warps: Array) -> tuple[Array, Array]:
    image, across, down = slopes(grey)
    sources = points[:, None] + np.column_stack([DX, DY]) @ np.swapaxes(np.linalg.inv(warps), 1, 2)
    template = centred(sample(reference.astype(np.float32), sources[..., 0], sources[..., 1]))
    there = start.astype(np.float32)
    for _ in range(3):
        gx, gy, off = patches(across, there), patches(down, there), patches(image, there) - template
        H = np.stack([(gx * gx) @ WINDOW, (gx * gy) @ WINDOW, (gx * gy) @ WINDOW, (gy * gy) @ WINDOW], -1)
        b = np.stack([(gx * off) @ WINDOW, (gy * off) @ WINDOW], -1)
        step = -np.linalg.solve(H.reshape(-1, 2, 2).astype(float), b[:, :, None].astype(float))[:, :, 0]
        there = (there + np.clip(step, -1, 1)).astype(np.float32)
    return there, likeness(patches(image, there), template)


def ready(*images: NDArray[np.uint8]) -> list[Pyramid]:
    return [pyramid_of(image, 0) for image in images]


def texture(seed: int) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).normal(size=(200, 260)).astype(np.float32)
    return np.clip(128 + 240 * cv2.GaussianBlur(noise, (0, 0), 1.8), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def moved() -> tuple[NDArray[np.uint8], NDArray[np.uint8], Array, Array]:
    """An image, the same moved by (1.3, -0.4) with noise, points of the first, and starts within 1 px of the truth."""
    rng, image = np.random.default_rng(5), texture(1)
    there = cv2.warpAffine(image, np.array([[1, 0, 1.3], [0, 1, -0.4]]), (260, 200), flags=cv2.INTER_CUBIC)
    there = np.clip(there + rng.normal(size=there.shape) * 2, 0, 255).astype(np.uint8)
    points = rng.uniform((12, 12), (248, 188), (150, 2)).astype(np.float32)
    start = (points + np.array([1.3, -0.4]) + rng.uniform(-0.7, 0.7, points.shape)).astype(np.float32)
    return image, there, points, start


def test_patches_go_where_numpy_says(moved: tuple[NDArray[np.uint8], NDArray[np.uint8], Array, Array]) -> None:
    image, other, points, start = moved
    rng = np.random.default_rng(2)
    warps = np.eye(2) + rng.uniform(-0.15, 0.15, (150, 2, 2))
    angles = rng.uniform(0, 2 * np.pi, 150)
    along = np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)
    for kernel, reference, hint in ((align_warped, warped_in_numpy, warps), (align_along, along_in_numpy, along)):
        there, likeness = kernel(*ready(image, other), points, start, hint)
        expected, expected_likeness = reference(image, other, points, start, hint)
        assert 0.1 < np.linalg.norm(there - start, axis=1).mean() < 2
        np.testing.assert_allclose(there, expected, atol=1e-3)
        np.testing.assert_allclose(likeness, expected_likeness, atol=1e-3)
        again = kernel(*ready(image, other), points, start, hint)
        assert there.tobytes() == again[0].tobytes() and likeness.tobytes() == again[1].tobytes()


def test_patches_at_the_border_go_where_numpy_says() -> None:
    """Test: points up to 2 px outside of it and 12 px inside. Expected: as above; what is outside does not pull."""
    rng, image = np.random.default_rng(0), texture(3)
    points = np.vstack(
        [np.column_stack([rng.uniform(low, low + 14, 50), rng.uniform(-5, 205, 50)]) for low in (-2, 248)]
    ).astype(np.float32)
    start = points + rng.uniform(-0.4, 0.4, points.shape).astype(np.float32)
    warps = np.tile(np.array([[1.05, 0.1], [-0.1, 0.95]]), (100, 1, 1))
    there, likeness = align_warped(*ready(image, image), points, start, warps)
    expected, expected_likeness = warped_in_numpy(image, image, points, start, warps)
    np.testing.assert_allclose(there, expected, atol=5e-3)  # there is little to hold some of them
    np.testing.assert_allclose(likeness, expected_likeness, atol=2e-3)


def test_patches_that_are_nowhere_stay() -> None:
    image = texture(0)
    points = np.array([[50, 50], [np.nan, 3], [1e30, 4], [60, 60]], np.float32)
    warps = np.tile(np.eye(2), (4, 1, 1))
    warps[3] = np.nan
    there, likeness = align_warped(*ready(image, image), points, points, warps)
    np.testing.assert_array_equal(there[1:], points[1:])
    assert likeness[0] > 0.999 and (likeness[1:] == 0).all()


# --- the pose ----------------------------------------------------------------------------------------------------


def scene(seed: int, n: int = 150) -> tuple[Array, Observations]:
    """A pose near the identity and what it sees, with outliers and readings of some of the depths."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-2, 2, (n, 2)), rng.uniform(2, 9, n)])
    T = se3.make(se3.exp_rotation(rng.normal(size=3) * 0.05), rng.normal(size=3) * 0.2)
    in_cam = se3.transform(se3.inverse(T), points)
    pixels = CAMERA.project_ideal(in_cam) + rng.normal(size=(n, 2)) * 0.7
    pixels[: n // 10] += rng.normal(size=(n // 10, 2)) * 8
    sigma = np.where(np.arange(n) % 3, 0.01, np.nan)
    inverse = np.where(np.isfinite(sigma), 1 / in_cam[:, 2] + rng.normal(size=n) * 0.01, np.nan)
    return T, Observations(points, pixels, inverse, sigma, rng.uniform(0, 0.3, n), np.array([0.3, -0.1, 0.05]))


def whitened(T: Array, o: Observations) -> tuple[Array, Array, Array]:
    """Return points in the camera, residuals (N, 3) and Jacobians (N, 3, 3), whitened by square roots of matrices."""
    in_cam = se3.transform(se3.inverse(T), o.landmarks)
    residuals, J = residuals_and_jacobian(in_cam, o, CAMERA, 0.7)
    for i, shift in enumerate(shift_of_distance(T, in_cam, o, J)):
        values, vectors = np.linalg.eigh(np.eye(2) + np.outer(shift, shift))
        root = vectors @ np.diag(values**-0.5) @ vectors.T
        residuals[i, :2], J[i, :2] = root @ residuals[i, :2], root @ J[i, :2]
    return in_cam, residuals, J


def weights_of(residuals: Array) -> Array:
    pixel = np.minimum(1, HUBER / np.linalg.norm(residuals[:, :2], axis=1))
    return np.column_stack([pixel, pixel, np.minimum(1, HUBER / np.maximum(np.abs(residuals[:, 2]), 1e-12))])


def by_pose(in_cam: Array) -> Array:
    return np.stack([np.hstack([se3.hat(p), -np.eye(3)]) for p in in_cam])


@pytest.mark.parametrize("seed", [0, 1])
def test_pose_is_where_the_equations_of_numpy_are_at_rest(seed: int) -> None:
    """Test: refined from 0.1 m and 2 degrees away. Expected: gradient nil there, covariance the inverse of their H."""
    true, o = scene(seed)
    prediction = Prediction(se3.make(np.eye(3), true[:3, 3] + 0.05), 0.1)
    start = true @ se3.make(se3.exp_rotation(np.array([0.02, -0.03, 0.01])), np.array([0.08, -0.05, 0.04]))
    T = start
    votes = np.random.default_rng(seed).uniform(0.5, 2, len(o.landmarks))
    settings = {"threshold_px": 1e9, "pixel_sigma": 0.7, "minimum": 6, "prediction": prediction, "votes": votes}
    for _ in range(4):  # robust weights converge slowly
        found = converge(T, np.ones(len(votes), bool), o, CAMERA, **settings)
        assert found is not None
        T, covariance = found[0].T_odom_cam, found[0].covariance
    in_cam, residuals, J_point = whitened(T, o)
    J, w = J_point @ by_pose(in_cam), weights_of(residuals)
    H, gradient = np.einsum("nka,nk,nkb->ab", J, w, J), np.einsum("nka,nk,nk->a", J, w, residuals)
    gradient[3:] += T[:3, :3].T @ (T[:3, 3] - prediction.T_odom_cam[:3, 3]) / 0.1**2
    H[np.arange(3, 6), np.arange(3, 6)] += 1 / 0.1**2
    assert np.abs(np.linalg.solve(H, gradient)).max() < 1e-5
    spread = max(1.0, np.median(np.linalg.norm(residuals[:, :2], axis=1)) / 1.1774)
    np.testing.assert_allclose(covariance, np.linalg.inv(H) * spread**2, rtol=1e-3, atol=1e-3 * covariance.max())
    assert 0 < np.linalg.norm(T[:3, 3] - true[:3, 3]) < 0.03
    errors = 0.7 * np.linalg.norm(residuals[:, :2], axis=1)
    assert found[0].inliers.all()
    np.testing.assert_allclose([found[0].reprojection_px, found[1]], [np.median(errors), votes @ errors], rtol=1e-9)


def test_a_pose_is_refined_again_on_the_inliers_it_leads_to() -> None:
    """Test: one in ten 8 px off, one landmark behind. Expected: the inliers are what numpy finds within the threshold
    of the pose, the rest cost the threshold each, and too few of them are no pose.
    """
    true, o = scene(7)
    o.landmarks[3] = true[:3, 3] - true[:3, 2]
    everybody, votes = np.ones(len(o.landmarks), bool), np.random.default_rng(1).uniform(0.5, 2, len(o.landmarks))
    settings = {"threshold_px": 2.0, "pixel_sigma": 0.7, "votes": votes}
    found = converge(true, everybody, o, CAMERA, minimum=50, **settings)
    assert found is not None
    estimate, score = found
    errors = 0.7 * np.linalg.norm(whitened(estimate.T_odom_cam, o)[1][:, :2], axis=1)
    expected = (errors < 2.0) & (np.arange(len(errors)) != 3)
    np.testing.assert_array_equal(estimate.inliers, expected)
    assert 0.8 * len(errors) < expected.sum() < len(errors) - 5
    assert score == pytest.approx(votes[expected] @ errors[expected] + 2 * votes[~expected].sum(), rel=1e-9)
    once = converge(estimate.T_odom_cam, estimate.inliers, o, CAMERA, minimum=50, **settings)
    assert once is not None
    np.testing.assert_allclose(once[0].T_odom_cam, estimate.T_odom_cam, atol=1e-4)
    assert converge(true, everybody, o, CAMERA, minimum=int(expected.sum()) + 5, **settings) is None


# --- the window --------------------------------------------------------------------------------------------------


def window(seed: int, n_poses: int = 6, n_landmarks: int = 60) -> BundleProblem:
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-3, 3, (n_landmarks, 2)), rng.uniform(3, 9, n_landmarks)])
    true = [
        se3.make(se3.exp_rotation(rng.normal(size=3) * 0.03), np.array([0.25 * k, 0.02 * k, 0.1 * k]))
        for k in range(n_poses)
    ]
    sees = rng.uniform(size=(n_landmarks, n_poses)) < 0.6
    sees[:, [1, 4]] = True
    landmark_of, keyframe_of = np.nonzero(sees)
    into = np.stack([se3.inverse(T) for T in true])[keyframe_of]
    in_cam = np.einsum("nij,nj->ni", into[:, :3, :3], points[landmark_of]) + into[:, :3, 3]
    n = len(in_cam)
    pixels = CAMERA.project_ideal(in_cam) + rng.normal(size=(n, 2)) * 0.5
    pixels[::25] += 12
    sigma = np.where(rng.uniform(size=n) < 0.6, 0.005, np.nan)
    inverse = np.where(np.isfinite(sigma), 1 / in_cam[:, 2] - 0.01 + rng.normal(size=n) * 0.005, np.nan)
    poses = np.stack([T if k < 2 else T @ se3.make(np.eye(3), rng.normal(size=3) * 0.03) for k, T in enumerate(true)])
    measured = Observations(np.zeros((n, 3)), pixels, inverse, sigma)
    start = points + rng.normal(size=points.shape) * 0.1
    return BundleProblem(poses, 2, start, keyframe_of, landmark_of, measured, DepthOffset.expected(0.02))


def linearise(p: BundleProblem, poses: Array, landmarks: Array, offset: float) -> tuple[float, Array, Array]:
    """Return cost, weighted residuals (R,) and the whole Jacobian (R, 6 K + 3 L + 1), nothing eliminated."""
    K, L, o = len(poses), len(landmarks), p.measured
    of_poses = poses[p.keyframe_of]
    in_cam = np.einsum("nji,nj->ni", of_poses[:, :3, :3], landmarks[p.landmark_of] - of_poses[:, :3, 3])
    residuals, J_point = residuals_and_jacobian(in_cam, o, CAMERA, 0.7)
    by_offset = -np.nan_to_num(1 / o.inverse_sigma)
    residuals[:, 2] += by_offset * offset
    root = np.sqrt(weights_of(residuals))
    norms = np.concatenate([np.linalg.norm(residuals[:, :2], axis=1), np.abs(residuals[:, 2])])
    cost = np.where(norms < HUBER, norms**2 / 2, HUBER * (norms - HUBER / 2)).sum()
    J = np.zeros((len(residuals), 3, 6 * K + 3 * L + 1))
    for n, (k, m) in enumerate(zip(p.keyframe_of, p.landmark_of, strict=True)):
        J[n, :, 6 * k : 6 * k + 6] = J_point[n] @ by_pose(in_cam[n : n + 1])[0]
        J[n, :, 6 * K + 3 * m : 6 * K + 3 * m + 3] = J_point[n] @ of_poses[n, :3, :3].T
        J[n, 2, -1] = by_offset[n]
    prior = p.depth_offset
    cost += prior.information * (offset - prior.value) ** 2 / 2
    return cost, (residuals * root).ravel(), (J * root[:, :, None]).reshape(len(residuals) * 3, -1)


def adjust_in_numpy(p: BundleProblem, iterations: int) -> tuple[Array, Array, float, float, Array]:
    poses, landmarks, offset, damping = p.poses.copy(), p.landmarks.copy(), p.depth_offset.value, INITIAL_DAMPING
    K, L, free = len(poses), len(landmarks), slice(6 * p.n_fixed, None)
    cost, r, J = linearise(p, poses, landmarks, offset)
    for _ in range(iterations):
        H, b = J.T @ J, J.T @ r
        H[np.diag_indices(len(H) - 1)] *= 1 + damping  # the last is the offset's
        H += 1e-9 * np.eye(len(H))
        H[-1, -1] += p.depth_offset.information
        b[-1] += p.depth_offset.information * (offset - p.depth_offset.value)
        delta = np.zeros(len(b))
        delta[free] = -np.linalg.solve(H[free, free], b[free])
        steps = delta[: 6 * K].reshape(K, 6)
        moved = np.stack([T @ se3.make(se3.exp_rotation(d[:3]), d[3:]) for T, d in zip(poses, steps, strict=True)])
        trial = moved, landmarks + delta[6 * K : -1].reshape(L, 3), offset + float(delta[-1])
        cost_there, r_there, J_there = linearise(p, *trial)
        if cost_there >= cost:
            damping *= 10
            continue
        decrease, damping = 1 - cost_there / cost, damping * 0.1
        (poses, landmarks, offset), cost, r, J = trial, cost_there, r_there, J_there
        if decrease < RELATIVE_DECREASE:
            break
    H = (J.T @ J)[free, free]
    H += 1e-9 * np.eye(len(H))
    information = H[-1, -1] - H[-1, :-1] @ np.linalg.solve(H[:-1, :-1], H[:-1, -1])
    own = (J.T @ J)[6 * K : -1, 6 * K : -1]
    covariances = np.stack([np.linalg.inv(own[3 * m : 3 * m + 3, 3 * m : 3 * m + 3]) for m in range(L)])
    return poses, landmarks, offset, float(information), covariances


@pytest.mark.parametrize(("seed", "iterations"), [(0, 1), (1, 6), (2, 12)])
def test_window_is_that_of_the_whole_system_in_numpy(seed: int, iterations: int) -> None:
    p = window(seed)
    result = adjust(p, CAMERA, pixel_sigma=0.7, iterations=iterations)
    poses, landmarks, offset, information, covariances = adjust_in_numpy(p, iterations)
    assert np.abs(result.poses - p.poses).max() > 0.01
    np.testing.assert_allclose(result.poses, poses, atol=1e-7)
    np.testing.assert_allclose(result.landmarks, landmarks, atol=1e-5)
    np.testing.assert_array_equal(result.poses[:2], np.stack([se3.orthonormalise(T) for T in p.poses[:2]]))
    assert result.depth_offset == pytest.approx(offset, rel=1e-6) and 0.005 < offset < 0.015 + 0.02 * (iterations == 1)
    assert result.depth_information == pytest.approx(information, rel=1e-4)
    np.testing.assert_allclose(result.landmark_covariances, covariances, rtol=1e-4, atol=1e-9)
    again = adjust(p, CAMERA, pixel_sigma=0.7, iterations=iterations)
    assert result.poses.tobytes() == again.poses.tobytes()
    assert result.landmarks.tobytes() == again.landmarks.tobytes()


def test_kernels_refuse_what_does_not_fit() -> None:
    image, points = texture(0), np.zeros((3, 2), np.float32)
    with pytest.raises(ValueError, match="start"):
        native.align_along(*ready(image, image), points, points[:2], points)
    with pytest.raises(TypeError):
        native.align_along(image, image, points, points, points)
    p = window(0)
    numbers = ((420.0, 410.0, 322.0, 238.0), 0.7, 0.0, 1.0, 1, 1e-4, 1e-4)
    arrays = p.measured.pixels, p.measured.inverse_depth, p.measured.inverse_sigma
    with pytest.raises(ValueError, match="names poses"):
        native.adjust(p.poses, 2, p.landmarks, p.keyframe_of + 1, p.landmark_of, *arrays, *numbers)
    with pytest.raises(ValueError, match="ascending"):
        native.adjust(p.poses, 2, p.landmarks, p.keyframe_of, p.landmark_of[::-1].copy(), *arrays, *numbers)
