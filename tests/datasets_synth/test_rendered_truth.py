"""Rendered revisits against the truth that follows from depth and poses; skipped where nothing can render."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark.datasets_synth.ground_truth import epipolar_distances, flow, place_truth
from seamark.datasets_synth.rendering import NoVulkanDevice, require_renderer
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
