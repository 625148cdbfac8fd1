"""Rendered revisits against the truth that follows from depth and poses; skipped where nothing can render."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark.datasets_synth import sensor, specification
from seamark.datasets_synth.ground_truth import epipolar_distances, flow, place_truth
from seamark.datasets_synth.panels import Panel
from seamark.datasets_synth.rendering import NoVulkanDevice, render_some, require_renderer
from seamark.datasets_synth.scenario import open_synth
from seamark.datasets_synth.sequence import SynthSequence
from seamark.datasets_synth.writing import write_sequence
from seamark.frontend import se3
from seamark.frontend.types import Frame

pytestmark = pytest.mark.simulator
SPEC = "loop,size=small,image=320x240,frames=48,seed=4"  # one lap and more in few frames


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    try:
        require_renderer()
    except NoVulkanDevice as missing:
        pytest.skip(str(missing))
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def lap(cache: Path) -> tuple[SynthSequence, list[Frame]]:
    sequence = open_synth(SPEC, cache_dir=cache)
    return sequence, list(sequence.frames())


def _depth(sequence: SynthSequence, frame: Frame) -> np.ndarray:
    assert frame.depth is not None
    return frame.depth / sequence.rig.depth_factor


def _matches(a: Frame, b: Frame) -> tuple[np.ndarray, np.ndarray]:
    sift = cv2.SIFT_create(1000, enable_precise_upscale=True)
    points_a, descriptors_a = sift.detectAndCompute(a.image, None)
    points_b, descriptors_b = sift.detectAndCompute(b.image, None)
    pairs = cv2.BFMatcher(cv2.NORM_L2, crossCheck=False).knnMatch(descriptors_a, descriptors_b, 2)
    good = [one for one, two in pairs if one.distance < 0.7 * two.distance]
    both = [(points_a[m.queryIdx].pt, points_b[m.trainIdx].pt) for m in good]
    return np.array([p for p, _ in both]).reshape(-1, 2), np.array([q for _, q in both]).reshape(-1, 2)


def test_revisits_share_surface_and_obey_the_epipolar_geometry(lap: tuple[SynthSequence, list[Frame]]) -> None:
    sequence, frames = lap
    poses = sequence.ground_truth.T_world_cam
    overlap = place_truth([_depth(sequence, frame) for frame in frames], poses, sequence.rig.cam0).overlap
    revisits = overlap[:6, 40:]
    early, late = (int(k) for k in np.unravel_index(revisits.argmax(), revisits.shape))
    assert revisits.max() > 0.5
    points_a, points_b = _matches(frames[early], frames[40 + late])
    T_a_b = se3.inverse(poses[early]) @ poses[40 + late]
    distances = epipolar_distances(points_a, points_b, sequence.rig.cam0, T_a_b)
    assert len(points_a) > 80
    assert 0 < np.median(distances) < 0.8
    assert np.mean(distances < 2) > 0.8
    far = np.unravel_index(overlap.argmin(), overlap.shape)
    assert overlap[far] == 0
    assert len(_matches(frames[int(far[0])], frames[int(far[1])])[0]) < 25


def _nearest(panels: Sequence[Panel], eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return how many times each ray (N, 3) fits between the eye and the first panel whose front it meets."""
    nearest = np.full(len(rays), np.inf)
    for panel in panels:
        facing = rays @ panel.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            times = ((panel.corner - eye) @ panel.normal) / facing
            places = eye + times[:, None] * rays - panel.corner
            shares = [places @ edge / (edge @ edge) for edge in (panel.right, panel.down)]
            inside = np.all([(share >= 0) & (share <= 1) for share in shares], axis=0)
        met = inside & (facing < 0) & (times > 0.05)
        nearest[met] = np.minimum(nearest[met], times[met])
    return nearest


def test_depth_of_an_ideal_sensor_is_where_rays_meet_the_world(cache: Path) -> None:
    wanted = specification.parse(SPEC + ",sensor=ideal")
    world, camera = wanted.build(), wanted.rig.cam0
    columns, rows = (grid.ravel() for grid in np.meshgrid(np.arange(3, 320, 7), np.arange(3, 240, 7)))
    rays = camera.rays(np.column_stack([columns, rows]).astype(np.float64))
    for coded in render_some(wanted, [0, 17, 40]):
        depth = sensor.decode(coded, 0, "").depth
        assert depth is not None
        measured = depth[rows, columns] / wanted.rig.depth_factor
        T_world_cam = wanted.poses()[coded.index]
        expected = _nearest(world.panels, T_world_cam[:3, 3], rays @ T_world_cam[:3, :3].T)
        errors = np.abs(measured - expected)[expected < 13]
        assert len(errors) > 1200
        assert 0 < np.median(errors) < 0.0002
        assert np.mean(errors < 0.001) > 0.99  # half a pixel is 17 mm on the floor 3 m away


def test_flow_agrees_with_rendered_pictures(lap: tuple[SynthSequence, list[Frame]]) -> None:
    sequence, frames = lap
    poses = sequence.ground_truth.T_world_cam
    points_a, points_b = _matches(frames[10], frames[11])
    moved = flow(_depth(sequence, frames[10]), sequence.rig.cam0, poses[10], poses[11])
    whole = np.rint(points_a).astype(int)
    errors = np.linalg.norm(moved[whole[:, 1], whole[:, 0]] - (points_b - points_a), axis=1)
    errors = errors[np.isfinite(errors)]
    assert len(errors) > 60
    assert 0 < np.median(errors) < 1.0


def test_a_layout_is_filled_from_the_cache(
    lap: tuple[SynthSequence, list[Frame]], cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("seamark.datasets_synth.rendering.COMMAND", ("/nonexistent",))  # nothing may be started
    written = write_sequence(SPEC, "tum", tmp_path / "out", cache_dir=cache)
    assert (written.frames, written.resumed) == (48, 0)
    picture = cv2.imread(str(tmp_path / "out" / "rgb" / "000007.jpg"))
    assert picture.tobytes() == lap[1][7].image.tobytes()
