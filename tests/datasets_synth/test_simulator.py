"""The real renderer: geometry, determinism and cache; skipped where nothing can render."""

import os
from collections.abc import Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark.datasets_synth import fallback, optics, sensor, specification
from seamark.datasets_synth.rendering import NoVulkanDevice, RenderPool, render_some, require_renderer
from seamark.datasets_synth.scenario import open_synth
from seamark.datasets_synth.sequence import SynthSequence
from seamark.frontend import se3
from seamark.frontend.types import Frame

pytestmark = pytest.mark.simulator
SPEC = "loop,size=small,image=320x240,frames=59,seed=2,sensors="  # 59 frames: one worker


def _first(sequence: SynthSequence, count: int) -> list[Frame]:
    with closing(sequence.frames()) as frames:  # type: ignore[type-var]
        return list(islice(frames, count))


@pytest.fixture(scope="module", autouse=True)
def _renderer() -> None:
    try:
        require_renderer()
    except NoVulkanDevice as missing:
        pytest.skip(str(missing))


@pytest.fixture(scope="module")
def rgbd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[SynthSequence, list[Frame]]]:
    sequence = open_synth(SPEC + "rgbd", cache_dir=tmp_path_factory.mktemp("cache"))
    yield sequence, list(sequence.frames())


def _megabytes(process: int) -> int:
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) // 1024 for line in lines if line.startswith("VmRSS"))


def _matches(a: Frame, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    sift = cv2.SIFT_create(1000, contrastThreshold=0.015, enable_precise_upscale=True)
    points_a, descriptors_a = sift.detectAndCompute(a.image, None)
    points_b, descriptors_b = sift.detectAndCompute(image, None)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors_a, descriptors_b, 2)
    good = [one for one, two in pairs if one.distance < 0.7 * two.distance]
    return (
        np.array([points_a[match.queryIdx].pt for match in good]),
        np.array([points_b[match.trainIdx].pt for match in good]),
    )


def _depth_at(sequence: SynthSequence, frame: Frame, points: np.ndarray) -> np.ndarray:
    assert frame.depth is not None
    whole = np.rint(points).astype(int)
    return frame.depth[whole[:, 1], whole[:, 0]] / sequence.rig.depth_factor


def test_pictures_agree_with_depth_and_pose(rgbd: tuple[SynthSequence, list[Frame]]) -> None:
    sequence, frames = rgbd
    poses = sequence.ground_truth.T_world_cam
    for first, second in ((0, 1), (20, 21), (1, 56)):
        a, b = _matches(frames[first], frames[second].image)
        depth = _depth_at(sequence, frames[first], a)
        T_b_a = se3.inverse(poses[second]) @ poses[first]
        predicted = sequence.rig.cam0.project(
            se3.transform(T_b_a, sequence.rig.cam0.rays(a) * depth[:, None])[depth > 0]
        )
        errors = predicted - b[depth > 0]
        assert len(errors) > 40
        assert np.median(np.linalg.norm(errors, axis=1)) < 0.5
        assert np.all(np.abs(np.median(errors, axis=0)) < 0.2)  # half a pixel would show


def test_pictures_are_neither_dark_nor_blown_out(rgbd: tuple[SynthSequence, list[Frame]]) -> None:
    for frame in rgbd[1]:
        assert 50 < frame.image.mean() < 190
        assert (frame.image.max(axis=2) >= 254).mean() < 0.1
        assert frame.depth is not None
        assert (frame.depth > 0).mean() > 0.7


def test_the_cache_gives_the_same_bits(rgbd: tuple[SynthSequence, list[Frame]]) -> None:
    sequence, frames = rgbd
    for a, b in zip(frames, sequence.frames(), strict=True):
        assert a.image.tobytes() == b.image.tobytes()
        assert a.depth is not None and b.depth is not None
        assert a.depth.tobytes() == b.depth.tobytes()


def test_rendering_again_gives_the_same_bits(rgbd: tuple[SynthSequence, list[Frame]], tmp_path: Path) -> None:
    for a, b in zip(rgbd[1][:2], _first(open_synth(SPEC + "rgbd", cache_dir=tmp_path), 2), strict=True):
        assert a.image.tobytes() == b.image.tobytes()
        assert a.depth is not None and b.depth is not None
        assert a.depth.tobytes() == b.depth.tobytes()


def test_stereo_disparity_agrees_with_depth(rgbd: tuple[SynthSequence, list[Frame]], tmp_path: Path) -> None:
    sequence, frames = rgbd
    stereo = open_synth(SPEC + "stereo", cache_dir=tmp_path)
    (pair,) = _first(stereo, 1)
    assert pair.image_right is not None
    assert pair.depth is None
    left, right = _matches(pair, pair.image_right)
    depth = _depth_at(sequence, frames[0], left)
    known = depth > 0
    expected = stereo.rig.cam0.fx * 0.12 / depth[known]
    errors = (left[:, 0] - right[:, 0])[known] - expected
    assert known.sum() > 100
    assert np.median(np.abs(errors)) < 0.4
    assert abs(np.median(errors)) < 0.15
    assert abs(np.median(left[:, 1] - right[:, 1])) < 0.1


def test_night_has_the_geometry_of_the_day(rgbd: tuple[SynthSequence, list[Frame]], tmp_path: Path) -> None:
    night = _first(open_synth(SPEC + "rgbd,condition=night", cache_dir=tmp_path), 2)
    for dark, bright in zip(night, rgbd[1][:2], strict=True):
        assert dark.depth is not None and bright.depth is not None
        assert dark.depth.tobytes() == bright.depth.tobytes()
        assert 0.05 < dark.image.mean() / bright.image.mean() < 0.9


def test_any_share_of_the_work_gives_the_same_bits() -> None:
    wanted = specification.parse("loop,size=small,image=320x240,frames=66,camera=real,condition=changing,movers=1")
    with RenderPool(wanted) as pool:
        assert len(pool.pids) == min(2, os.cpu_count() or 1)
        shared = list(islice(pool.frames(), 9))
    with RenderPool(wanted, begin=5) as pool:
        resumed = list(islice(pool.frames(), 4))
    alone = list(render_some(wanted, [0, 3, 8]))
    assert [frame.blobs for frame in resumed] == [frame.blobs for frame in shared[5:]]
    assert [frame.blobs for frame in alone] == [shared[index].blobs for index in (0, 3, 8)]


def test_labels_come_back_from_the_cache_and_change_nothing_else(tmp_path: Path) -> None:
    spec = SPEC + "rgbd,movers=3"
    sequence = open_synth(spec + ",labels=1", cache_dir=tmp_path)
    frames = list(sequence.frames())
    (cached,) = (tmp_path / "synth").iterdir()
    files = {file.stem: file.read_bytes() for file in (cached / "labels").iterdir()}
    again = {frame.index: frame.labels for frame in render_some(specification.parse(spec + ",labels=1"), [0, 30, 58])}
    assert {index: files[f"{index:06d}"] for index in again} == again
    labels = list(sequence.labels())
    assert all(image.shape == (240, 320) and image.dtype == np.uint8 for image in labels)
    assert all(set(np.unique(image)) <= {0, 1, 10, 11, 12} for image in labels)
    assert all((image == 0).mean() < 0.002 for image in labels)
    assert max(float((image >= 10).mean()) for image in labels) > 0.01
    for with_labels, without in zip(frames, _first(open_synth(spec, cache_dir=tmp_path), 2), strict=False):
        assert with_labels.image.tobytes() == without.image.tobytes()


def test_a_distorting_camera_sees_people_and_tells_which_pixels_they_are() -> None:
    wanted = specification.parse(SPEC + "rgbd,camera=barrel,movers=3,labels=1")
    with RenderPool(wanted) as pool:
        frames_coded = pool.frames()
        coded = list(islice(frames_coded, 10))
        before = _megabytes(pool.pids[0])
        coded += list(islice(frames_coded, 35))
        assert _megabytes(pool.pids[0]) - before < 60  # changing the exposure of a camera once leaked 7 MB per frame
    labels = [cv2.imdecode(np.frombuffer(frame.labels, np.uint8), cv2.IMREAD_UNCHANGED) for frame in coded]
    assert set(np.unique(labels)) <= {0, 1, 10, 11, 12}
    shares = [float((image >= 10).mean()) for image in labels]
    assert 0.03 < max(shares) < 0.6
    frames, poses = [sensor.decode(frame, 0, "") for frame in coded], wanted.poses()
    quiet = [k for k in range(36) if shares[k] < 0.02 and shares[k + 3] < 0.02]
    first, second = quiet[0], quiet[0] + 3
    a, b = _matches(frames[first], frames[second].image)
    depth = frames[first].depth
    assert depth is not None
    whole = np.rint(a).astype(int)
    z = depth[whole[:, 1], whole[:, 0]] / wanted.rig.depth_factor
    camera = wanted.rig.cam0
    assert camera.distortion == optics.MODELS["barrel"].distortion
    T_b_a = se3.inverse(poses[second]) @ poses[first]
    errors = camera.project(se3.transform(T_b_a, camera.rays(a) * z[:, None])[z > 0]) - b[z > 0]
    assert len(errors) > 40
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.5
    assert np.all(np.abs(np.median(errors, axis=0)) < 0.25)


def test_the_loop_is_still_the_one_that_is_kept() -> None:
    wanted, kept = specification.parse(fallback.SPECIFICATION), open_synth("small_loop")
    assert np.allclose(wanted.poses(), kept.ground_truth.T_world_cam, atol=1e-8)
    (coded,) = render_some(wanted, [110])
    now = sensor.decode(coded, 0, "").image.astype(np.float64)
    then = next(islice(kept.frames(), 110, None)).image
    assert 0.5 < np.abs(now - then).mean() < 8  # the kept one is coded coarser
    assert np.abs(now.mean(axis=(0, 1)) - then.mean(axis=(0, 1))).max() < 0.5
