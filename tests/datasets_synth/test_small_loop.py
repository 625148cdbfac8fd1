"""The kept sequence: small, complete, and true to its own ground truth."""

import cv2
import numpy as np
import pytest

from seamark import SeamarkError
from seamark.datasets_synth.fallback import small_loop_path
from seamark.datasets_synth.scenario import open_synth
from seamark.datasets_synth.sequence import SynthSequence
from seamark.frontend import se3
from seamark.frontend.types import Frame, Mode


@pytest.fixture(scope="module")
def sequence() -> SynthSequence:
    return open_synth("small_loop")


def test_it_is_small_and_complete(sequence: SynthSequence) -> None:
    files = [path for path in small_loop_path().rglob("*") if path.is_file()]
    assert 3e6 < sum(path.stat().st_size for path in files) < 7e6
    assert sequence.n_frames == 220
    assert sequence.mode is Mode.RGBD
    assert len(list((small_loop_path() / "rgb").iterdir())) == 220
    assert len((small_loop_path() / "associations.txt").read_text().splitlines()) == 220
    first = next(sequence.frames())
    assert first.image.shape == (240, 320, 3)
    assert first.depth is not None and first.depth.dtype == np.uint16


def test_it_comes_back(sequence: SynthSequence) -> None:
    positions = sequence.ground_truth.T_world_cam[:, :3, 3]
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() > 18
    assert np.linalg.norm(positions[200:] - positions[0], axis=1).min() < 0.3
    assert np.linalg.norm(positions - positions[0], axis=1).max() > 5


def test_depth_and_poses_predict_where_points_are_seen(sequence: SynthSequence) -> None:
    frames = list(sequence.frames())
    for first, second in ((0, 3), (100, 103), (4, 212)):
        errors = reprojection_errors(sequence, frames[first], frames[second])
        assert len(errors) > 50
        assert np.median(np.linalg.norm(errors, axis=1)) < 0.7
        assert np.all(np.abs(np.median(errors, axis=0)) < 0.2)


def reprojection_errors(sequence: SynthSequence, a: Frame, b: Frame) -> np.ndarray:
    """Return (N, 2) px: where SIFT sees the points of a in b, minus where depth and ground truth put them."""
    sift = cv2.SIFT_create(1000, enable_precise_upscale=True)
    points_a, descriptors_a = sift.detectAndCompute(a.image, None)
    points_b, descriptors_b = sift.detectAndCompute(b.image, None)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors_a, descriptors_b, 2)
    good = [one for one, two in pairs if one.distance < 0.7 * two.distance]
    seen_a = np.array([points_a[match.queryIdx].pt for match in good])
    seen_b = np.array([points_b[match.trainIdx].pt for match in good])
    assert a.depth is not None
    whole = np.rint(seen_a).astype(int)
    depth = a.depth[whole[:, 1], whole[:, 0]] / sequence.rig.depth_factor
    poses = sequence.ground_truth.T_world_cam
    T_b_a = se3.inverse(poses[b.index]) @ poses[a.index]
    known = depth > 0
    points = se3.transform(T_b_a, (sequence.rig.cam0.rays(seen_a) * depth[:, None])[known])
    return sequence.rig.cam0.project(points) - seen_b[known]


def test_it_takes_no_settings() -> None:
    with pytest.raises(SeamarkError, match="takes no settings"):
        open_synth("small_loop,frames=20")
