"""What people hide, how they move and how they are blurred, in rendered pictures; skipped where nothing can render."""

from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from seamark.datasets_synth import people, sensor, specification
from seamark.datasets_synth.ground_truth import flow
from seamark.datasets_synth.rendering import NoVulkanDevice, render_some, require_renderer
from seamark.datasets_synth.specification import Specification
from seamark.frontend.types import Frame

pytestmark = pytest.mark.simulator
CROWD = "loop,trajectory=loop,image=320x240,crowd=40,seed=1"


@pytest.fixture(scope="module", autouse=True)
def _renderer() -> None:
    try:
        require_renderer()
    except NoVulkanDevice as missing:
        pytest.skip(str(missing))


def _rendered(wanted: Specification, indices: Sequence[int]) -> list[tuple[Frame, np.ndarray]]:
    out = []
    for coded in render_some(wanted, indices):
        labels = cv2.imdecode(np.frombuffer(coded.labels, np.uint8), cv2.IMREAD_UNCHANGED) if coded.labels else None
        out.append((sensor.decode(coded, 0, str(coded.index)), labels))
    return out


def test_people_hide_the_share_that_was_asked_for() -> None:
    wanted = specification.parse(CROWD + ",frames=400,labels=1,sensors=mono")
    shares = [float((labels >= 10).mean()) for _, labels in _rendered(wanted, range(0, 400, 8))]
    assert 0.34 < np.percentile(shares, 95) < 0.47
    assert max(shares) < 0.5
    assert np.median(shares) > 0.08


def test_flow_of_people_is_what_the_pictures_show() -> None:
    wanted = specification.parse(CROWD + ",frames=400,labels=2,sensors=rgbd")
    poses, crowd = wanted.poses(), people.people_of(wanted)
    errors, as_if_still = [], []
    firsts = (30, 90, 150, 210, 270)
    rendered = _rendered(wanted, [first + more for first in firsts for more in (0, 1)])
    for first, (a, labels), (b, _) in zip(firsts, rendered[::2], rendered[1::2], strict=True):
        assert a.depth is not None
        depth = a.depth / wanted.rig.depth_factor
        moved = flow(
            depth, wanted.rig.cam0, poses[first], poses[first + 1], labels, crowd.displacements(first, first + 1)
        )
        still = flow(depth, wanted.rig.cam0, poses[first], poses[first + 1])
        inside = cv2.erode((labels >= 32).astype(np.uint8), np.ones((9, 9), np.uint8))
        grey = [cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY) for frame in (a, b)]
        points = cv2.goodFeaturesToTrack(grey[0], 150, 0.02, 5, mask=inside)
        if points is None:
            continue
        tracked, found, _ = cv2.calcOpticalFlowPyrLK(*grey, points, None, winSize=(11, 11))
        back, _, _ = cv2.calcOpticalFlowPyrLK(grey[1], grey[0], tracked, None, winSize=(11, 11))
        good = (found.ravel() > 0) & (np.linalg.norm((back - points)[:, 0], axis=1) < 0.3)
        whole = np.rint(points[good, 0]).astype(int)
        seen = (tracked - points)[good, 0]
        errors.append(np.linalg.norm(moved[whole[:, 1], whole[:, 0]] - seen, axis=1))
        as_if_still.append(np.linalg.norm(still[whole[:, 1], whole[:, 0]] - seen, axis=1))
    error, wrong = (np.concatenate(values) for values in (errors, as_if_still))
    known = np.isfinite(error)
    assert known.sum() > 60
    assert 0 < np.median(error[known]) < 0.5
    assert np.mean(error[known] < 1.5) > 0.8
    assert np.median(wrong[known]) > 2 * np.median(error[known])


def test_a_frame_of_a_crowd_does_not_depend_on_those_before() -> None:
    wanted = specification.parse(CROWD + ",frames=60,sensors=stereo,camera=real")
    alone = next(iter(render_some(wanted, [9])))
    last = list(render_some(wanted, [2, 5, 9]))[-1]
    assert alone == last
    assert len(alone.right) > 1000
