"""Poses refined by depth images, against scenes of planes whose depth is worked out ray by ray."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from seamark.backend.align_surfaces import align, aligned
from seamark.backend.config import AlignmentConfig, VerificationConfig
from seamark.backend.evidence import Evidence, Gate
from seamark.backend.surfaces import Surface, surface, surface_of
from seamark.backend.types import Reason
from seamark.backend.verify import Rejected, Verification, verify
from seamark.frontend.camera import Camera
from seamark.frontend.config import FrontendConfig
from seamark.frontend.keyframe_depth import encode_depth
from seamark.frontend.types import Features, Keyframe

CAMERA = Camera(320, 240, 205.0, 207.0, 160.0, 118.0)
CONFIG = AlignmentConfig()
#: Planes n . X = d of a room about the first camera, which looks along z; and a crate in it.
WALLS = [((0, 0, 1), 4.0), ((1, 0, 0.2), 2.0), ((-1, 0, 0.1), 1.7), ((0, 1, 0.05), 1.3), ((0, -1, 0), 1.2)]
ROOM = [*WALLS, ((0.6, 0.3, 0.74), 2.5)]
ONE_WALL = [((0.0, 0.0, 1.0), 2.5)]
SIGMA = np.repeat([0.004, 0.02], 3)  # of the poses to start from: rad, m


def depth_of(
    planes: list[tuple[tuple[float, float, float], float]],
    T_world_cam: NDArray[np.float64],
    rng: np.random.Generator | None = None,
    noise: float = 0.001,
) -> NDArray[np.float32]:
    """Return the depth (H, W) in m of the nearest plane along each ray, with noise that grows with its square."""
    rows, columns = np.indices((CAMERA.height, CAMERA.width))
    rays = np.stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones(rows.shape)], axis=-1)
    depth = np.full(rows.shape, np.inf)
    for normal, distance in planes:
        n = np.array(normal) / np.linalg.norm(normal)
        towards = rays @ (T_world_cam[:3, :3].T @ n)
        with np.errstate(divide="ignore"):
            z = (distance - n @ T_world_cam[:3, 3]) / towards
        depth = np.where((z > 0) & (z < depth), z, depth)
    if rng is not None:
        depth = depth + noise * depth**2 * rng.standard_normal(depth.shape)
    return np.where(np.isfinite(depth) & (depth < 8), depth, 0).astype(np.float32)


def surface_at(planes: list, T_world_cam: NDArray[np.float64], rng: np.random.Generator) -> Surface:
    found = surface_of(view(planes, T_world_cam, rng))
    assert found is not None
    return found


def view(planes: list, T_world_cam: NDArray[np.float64], rng: np.random.Generator, **fields: object) -> Keyframe:
    depth = encode_depth(depth_of(planes, T_world_cam, rng), 1.0, FrontendConfig(keyframe_depth_px=160))
    values = {"id": 0, "session": 0, "index": 0, "stamp_ns": 0, "file": "a", "camera": CAMERA} | fields
    return Keyframe(
        features=Features.empty(),
        landmarks=np.zeros((0, 3), np.float32),
        thumbnail=np.zeros((1, 1), np.uint8),
        jpeg=b"",
        depth=depth,
        **values,  # type: ignore[arg-type]
    )


def displaced(T: NDArray[np.float64], rng: np.random.Generator, move) -> NDArray[np.float64]:
    e = SIGMA * rng.standard_normal(6)
    return T @ move(tuple(e[:3]), tuple(e[3:]))


def error(T: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    E = np.linalg.inv(truth) @ T
    return np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1], *(2 * E[:3, 3])]) / 2


def test_points_and_normals_are_those_of_the_planes(move) -> None:
    depth = depth_of(ONE_WALL, move((0.2, -0.3, 0.1), (0.3, 0.1, 0.2)))
    found = surface(np.where(depth[::2, ::2] > 0, 1 / depth[::2, ::2], 0).astype(float), CAMERA, 2)
    rotation = move((0.2, -0.3, 0.1), (0, 0, 0))[:3, :3]
    normals = found.normals[np.isfinite(found.normals[:, 0])]
    assert len(normals) > 0.9 * 118 * 158
    np.testing.assert_allclose(normals, np.tile(rotation.T @ (0, 0, 1), (len(normals), 1)), atol=0.01)
    world = found.points @ rotation.T + (0.3, 0.1, 0.2)
    assert np.nanmax(np.abs(world[:, 2] - 2.5)) < 0.03  # half a pixel of the sensor beside the ray that was sampled


def test_a_pose_in_a_room_becomes_several_times_better_and_its_covariance_is_honest(move) -> None:
    """Test: 30 views of a room of planes from poses that features know to 0.2 degrees and 2 cm.

    Expected: millimetres are left. Chi squared of what is left is below its mean of 6, because this camera has none
    of the common errors that the covariance allows for, but not by orders of magnitude.
    """
    rng = np.random.default_rng(5)
    before, after, chi2 = [], [], []
    for _ in range(30):
        truth = move(tuple(rng.normal(0, 0.12, 3)), tuple(rng.normal(0, 0.2, 3)))
        query, match = surface_at(ROOM, truth, rng), surface_at(ROOM, np.eye(4), rng)
        start = displaced(truth, rng, move)
        found = align(start, np.diag(SIGMA**2), query, match, CONFIG)
        assert found.overlap > 0.4 and found.through < 0.01
        assert found.shift_chi2 < 30 and 0.1 < found.misfit < 1.5
        left = error(found.T_match_query, truth)
        before.append(np.abs(error(start, truth)))
        after.append(np.abs(left))
        chi2.append(left @ np.linalg.solve(found.covariance, left))
    gain = np.median(before, axis=0) / np.median(after, axis=0)
    assert (gain > 2).all() and np.median(after, axis=0)[3:].max() < 0.003
    assert 0.05 < np.mean(chi2) < 6


def test_what_a_single_wall_leaves_free_stays_as_unsure_as_it_was(move) -> None:
    """Test: one wall, seen squarely. Expected: its distance and tilt become sure, sliding and turning on it do not."""
    rng = np.random.default_rng(6)
    query, match = (surface_at(ONE_WALL, np.eye(4), rng) for _ in range(2))
    start = move((0.003, -0.002, 0.004), (0.02, -0.015, 0.02))
    found = align(start, np.diag(SIGMA**2), query, match, CONFIG)
    share = np.sqrt(np.diag(found.covariance)) / SIGMA
    about_x, about_y, about_z, x, y, z = share
    assert max(about_x, about_y, z) < 0.35
    assert min(about_z, x, y) > 0.85
    left = error(found.T_match_query, np.eye(4))
    assert abs(left[5]) < 0.003 and np.abs(left[:2]).max() < 0.001
    np.testing.assert_allclose(left[[2, 3, 4]], (0.004, 0.02, -0.015), atol=0.002)


def verified(T: NDArray[np.float64]) -> Verification:
    seen = Evidence(np.zeros((40, 4), np.float32), np.ones(40, bool), (Gate("inliers", 40, 15),))
    return Verification(40, 50, T, np.diag(SIGMA**2), evidence=seen)


def names(result: Verification | Rejected) -> list[str]:
    assert result.evidence is not None
    return [gate.name for gate in result.evidence.gates]


def test_a_pose_that_looks_through_a_wall_is_refused_and_one_behind_a_screen_is_not(move) -> None:
    """Test: a screen fills the left of one view only, once where the pose says that it stood at both times.

    Expected: a pose under which both cameras stand at one place and only one sees the screen is refused. One from
    which the other camera stands behind the screen's edge, so that it hides what the other sees, is not.
    """
    rng = np.random.default_rng(7)
    screen = [*ROOM, ((0.0, 0.0, 1.0), 1.0)]
    bare, covered = view(ROOM, np.eye(4), rng), view(screen, np.eye(4), rng)
    for query, match in ((bare, covered), (covered, bare)):
        refused = aligned(verified(np.eye(4)), query, match, CONFIG)
        assert isinstance(refused, Rejected)
        assert (refused.reason, refused.inliers, names(refused)[-1]) == (Reason.CONTRADICTED, 40, "depth_through")
    beside = move((0, 0, 0), (0.0, 0.0, 1.2))  # past the screen: it is behind this camera
    query = view(ROOM, beside, rng)
    kept = aligned(verified(beside), query, covered, CONFIG)
    assert isinstance(kept, Verification)


def test_gates_say_why_a_pose_stays_as_it_was(move) -> None:
    rng = np.random.default_rng(8)
    truth = move((0.02, 0.05, -0.01), (0.1, 0.02, -0.1))
    query, match = view(ROOM, truth, rng), view(ROOM, np.eye(4), rng)
    start = verified(displaced(truth, rng, move))
    refined = aligned(start, query, match, CONFIG)
    assert isinstance(refined, Verification) and refined.T_match_query is not start.T_match_query
    assert names(refined) == ["inliers", "depth_through", "align_overlap", "align_misfit", "align_shift_chi2"]
    assert refined.evidence is not None and all(gate.passed for gate in refined.evidence.gates)
    for limit, name in (
        ({"max_shift_chi2": 1e-6}, "align_shift_chi2"),
        ({"max_misfit": 0.01}, "align_misfit"),
        ({"min_overlap": 0.999}, "align_overlap"),
    ):
        kept = aligned(start, query, match, AlignmentConfig(**limit))
        assert isinstance(kept, Verification) and kept.evidence is not None
        assert kept.T_match_query is start.T_match_query and kept.covariance is start.covariance
        assert [gate.name for gate in kept.evidence.gates if not gate.passed] == [name]
    # Nothing of one is seen by the other.
    away = aligned(verified(move((0, np.pi, 0), (0, 0, 0))), query, match, CONFIG)
    assert isinstance(away, Verification) and away.evidence is not None and away.covariance is not None
    assert [gate.name for gate in away.evidence.gates if not gate.passed] == ["align_overlap"]


@pytest.mark.parametrize(
    "change",
    [
        {"depth": b""},
        {"depth": b"\x89PNG rubbish"},
        {"camera": None},
        {"metric": False},
        {"camera": Camera(64, 48, 50, 50, 32, 24)},
    ],
    ids=["none", "rubbish", "uncalibrated", "no scale", "of another camera"],
)
def test_without_a_depth_image_of_both_nothing_changes(change: dict[str, object]) -> None:
    rng = np.random.default_rng(9)
    whole, without = view(ROOM, np.eye(4), rng), replace(view(ROOM, np.eye(4), rng), **change)
    start = verified(np.eye(4))
    assert aligned(start, whole, without, CONFIG) is start
    assert aligned(start, without, whole, CONFIG) is start


def test_the_same_input_gives_the_same_bits(move) -> None:
    rng = np.random.default_rng(10)
    query, match = surface_at(ROOM, move((0, 0.1, 0), (0.1, 0, 0)), rng), surface_at(ROOM, np.eye(4), rng)
    first, second = (align(move((0, 0.1, 0), (0.11, 0, 0)), np.diag(SIGMA**2), query, match, CONFIG) for _ in range(2))
    assert first.T_match_query.tobytes() == second.T_match_query.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()


def test_verification_goes_on_to_surfaces_unless_told_not_to(world, move) -> None:
    """Test: features and depth of one scene. Expected: the pose of features alone, or one that surfaces have moved."""
    rng, scene = np.random.default_rng(11), world(2)
    truth = move((0.01, 0.03, 0), (0.05, 0.02, 0.0))
    camera = replace(CAMERA, width=640, height=480, fx=500.0, fy=505.0, cx=320.0, cy=240.0)
    query, match = (
        replace(
            scene.view(T, camera),
            depth=encode_depth(depth_of(ROOM, T, rng), 1.0, FrontendConfig(keyframe_depth_px=160)),
        )
        for T in (truth, np.eye(4))
    )
    features = verify(query, match, VerificationConfig(), 3)
    assert isinstance(features, Verification)
    assert aligned(features, query, match, AlignmentConfig(enabled=False)) is features
    refined = aligned(features, query, match, CONFIG)
    assert set(names(refined)) - set(names(features)) >= {"align_overlap"}
    unlike = verify(query, scene.view(truth, clutter=5, outliers=1.0), VerificationConfig(), 3)
    assert isinstance(unlike, Rejected) and aligned(unlike, query, match, CONFIG) is unlike
