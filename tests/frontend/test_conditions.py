"""Frames in any condition on the toy world: each has a defined outcome, and good frames after it go on."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from seamark.datasets_synth.toy import ToyWorld, toy_sequence
from seamark.frontend import se3
from seamark.frontend.admission import StampGate
from seamark.frontend.config import FrontendConfig
from seamark.frontend.odometry import Frontend
from seamark.frontend.tone import match_tone, tone_curve
from seamark.frontend.types import Frame, Loss, Mode, Odometry, Outcome, Quality

CONFIG = FrontendConfig(max_corners=250, sift_features=300)
WORLD = ToyWorld(7)
HOUR_NS = 3_600_000_000_000
POSED = {Outcome.TRACKED, Outcome.RECOVERED}


def walk(n: int, mode: Mode = Mode.RGBD) -> tuple[list[Frame], np.ndarray]:
    """Return the first frames of a lap, about 10 cm apart, and their true poses."""
    sequence = toy_sequence("loop", 160, sensors=mode, world=WORLD)
    frames = [frame for frame, _ in zip(sequence.frames(), range(n), strict=False)]
    return frames, sequence.ground_truth.T_world_cam[:n]


def track(frames: Sequence[Frame], mode: Mode = Mode.RGBD, config: FrontendConfig = CONFIG) -> list[Odometry]:
    frontend = Frontend(WORLD.rig(mode), mode, config)
    try:
        return [frontend.step(frame).odometry for frame in frames]
    finally:
        frontend.close()


def worst_error(odometry: Sequence[Odometry], truth: np.ndarray) -> float:
    """Return the largest distance (m) of a posed frame from the truth, both relative to the first frame."""
    origin = odometry[0].T_odom_cam
    assert origin is not None
    worst = 0.0
    for one, T in zip(odometry, truth, strict=True):
        if one.T_odom_cam is not None:
            estimate, true = se3.inverse(origin) @ one.T_odom_cam, se3.inverse(truth[0]) @ T
            worst = max(worst, float(np.linalg.norm(estimate[:3, 3] - true[:3, 3])))
    return worst


def shifted(frames: Sequence[Frame], by_ns: int) -> list[Frame]:
    return [replace(frame, stamp_ns=frame.stamp_ns + by_ns) for frame in frames]


def outcomes(odometry: Sequence[Odometry]) -> list[Outcome]:
    return [one.outcome for one in odometry]


# Stamps


def test_ten_per_cent_of_the_frames_missing_at_random_is_tracked() -> None:
    """Test: of 40 frames 4 never come. Expected: all others have a pose in one session, as exact as without gaps."""
    frames, truth = walk(40)
    kept = np.delete(np.arange(40), 1 + np.random.default_rng(4).choice(39, 4, replace=False))
    odometry = track([frames[i] for i in kept])
    assert set(outcomes(odometry[1:])) <= POSED
    assert {one.session for one in odometry} == {0}
    assert 0 < worst_error(odometry, truth[kept]) < 0.06


def test_frames_sent_twice_are_refused_once() -> None:
    """Test: every third frame comes twice. Expected: the copy is REPEATED_STAMP, the first is tracked."""
    frames, truth = walk(12)
    sent = sorted([*range(12), *range(0, 12, 3)])
    odometry = track([frames[i] for i in sent])
    copies = [i > 0 and sent[i] == sent[i - 1] for i in range(len(sent))]
    assert [one.outcome is Outcome.REPEATED_STAMP for one in odometry] == copies
    assert {one.session for one, copy in zip(odometry, copies, strict=True) if not copy} == {0}
    assert 0 < worst_error(odometry, truth[sent]) < 0.05


def test_a_picture_repeated_under_new_stamps_is_a_camera_that_stands() -> None:
    """Test: a camera freezes for 5 frames. Expected: tracked on the spot, and on as the picture moves again."""
    frames, truth = walk(12)
    sent = [0, 1, 2, 3, 4, 5, 5, 5, 5, 5, 5, *range(6, 12)]
    odometry = track([replace(frames[i], stamp_ns=frames[0].stamp_ns + k * 66_666_667) for k, i in enumerate(sent)])
    assert set(outcomes(odometry[1:])) <= POSED
    frozen = np.stack([one.T_odom_cam[:3, 3] for one in odometry[6:11]])
    assert np.abs(frozen - frozen[0]).max() < 0.002
    assert 0 < worst_error(odometry, truth[sent]) < 0.05


def test_frames_that_overtake_each_other_are_refused_when_late() -> None:
    """Test: twice two frames change places. Expected: the late one is STAMP_BACKWARD, no session ends."""
    frames, truth = walk(14)
    sent = [0, 1, 2, 4, 3, 5, 6, 7, 8, 10, 9, 11, 12, 13]
    odometry = track([frames[i] for i in sent])
    assert [i for i, one in enumerate(odometry) if one.outcome is Outcome.STAMP_BACKWARD] == [4, 10]
    assert {one.session for i, one in enumerate(odometry) if i not in (4, 10)} == {0}
    assert 0 < worst_error(odometry, truth[sent]) < 0.05


@pytest.mark.parametrize("mode", [Mode.RGBD, Mode.MONO])
def test_a_clock_set_back_for_good_begins_a_new_session(mode: Mode) -> None:
    """Test: from frame 8 on all stamps are an hour earlier.

    Expected: four frames are refused, the fifth is CLOCK_RESET and begins session 1, whose odometry goes on from where
    session 0 ended; nothing is refused any more.
    """
    frames, _ = walk(18, mode)
    odometry = track([*frames[:8], *shifted(frames[8:], -HOUR_NS)], mode)
    assert outcomes(odometry)[8:13] == [Outcome.STAMP_BACKWARD] * 4 + [Outcome.CLOCK_RESET]
    assert {one.session for one in odometry[:8]} == {0}
    assert {one.session for one in odometry[12:]} == {1}
    if mode is Mode.RGBD:
        assert set(outcomes(odometry[13:])) == {Outcome.TRACKED}
        np.testing.assert_allclose(odometry[12].T_odom_cam, odometry[7].T_odom_cam, atol=1e-9)


@pytest.mark.parametrize(
    ("by_ns", "outcome"), [(-HOUR_NS, Outcome.STAMP_BACKWARD), (24 * HOUR_NS, Outcome.STAMP_FORWARD)]
)
def test_one_wrong_stamp_is_not_believed(by_ns: int, outcome: Outcome) -> None:
    """Test: one stamp of 14 is an hour back, or a day ahead. Expected: that frame is refused and no other."""
    frames, truth = walk(14)
    frames[6:7] = shifted(frames[6:7], by_ns)
    odometry = track(frames)
    assert outcomes(odometry)[6] is outcome
    assert {one.session for i, one in enumerate(odometry) if i != 6} == {0}
    assert set(outcomes([*odometry[1:6], *odometry[7:]])) <= POSED
    assert 0 < worst_error(odometry, truth) < 0.05


def test_a_clock_set_forward_for_good_costs_one_frame() -> None:
    """Test: from frame 6 on stamps are an hour later, the scene goes on. Expected: frame 6 waits, 7 is tracked."""
    frames, truth = walk(14)
    odometry = track([*frames[:6], *shifted(frames[6:], HOUR_NS)])
    assert outcomes(odometry)[6] is Outcome.STAMP_FORWARD
    assert set(outcomes(odometry[7:])) <= POSED
    assert {one.session for one in odometry[7:]} == {0}
    assert 0 < worst_error(odometry, truth) < 0.05


def test_mode_places_takes_pictures_however_far_apart_and_a_clock_set_back() -> None:
    gate = StampGate(Mode.PLACES, CONFIG)
    assert [gate.admit(k * 60 * 10**9) for k in range(4)] == [None] * 4
    back = [gate.admit(k) for k in range(6)]
    assert back == [Outcome.STAMP_BACKWARD] * 4 + [Outcome.CLOCK_RESET, None]


def test_stamps_in_no_order_never_pass_for_a_new_clock() -> None:
    """Test: after stamp 100 come stamps that fall, and pairs that rise between good ones. Expected: no reset."""
    gate = StampGate(Mode.RGBD, CONFIG)
    assert gate.admit(100) is None
    assert {gate.admit(stamp) for stamp in range(90, 60, -1)} == {Outcome.STAMP_BACKWARD}
    for newest in range(101, 110):
        assert gate.admit(newest) is None
        assert {gate.admit(stamp) for stamp in (10, 11, 12, 13)} == {Outcome.STAMP_BACKWARD}


# Pictures


def test_another_resolution_for_a_while_is_refused_and_then_the_session_goes_on() -> None:
    """Test: three frames come in half size. Expected: WRONG_SIZE thrice, then a pose in the same session."""
    frames, truth = walk(14)
    for i in (5, 6, 7):
        frames[i] = replace(frames[i], image=np.ascontiguousarray(frames[i].image[::2, ::2]))
    odometry = track(frames)
    assert [i for i, one in enumerate(odometry) if one.outcome is Outcome.WRONG_SIZE] == [5, 6, 7]
    assert set(outcomes(odometry[8:])) <= POSED
    assert {one.session for one in odometry[8:]} == {0}
    assert 0 < worst_error(odometry, truth) < 0.05


BLIND: list[tuple[str, Callable[[np.ndarray], np.ndarray], Loss]] = [
    ("black", np.zeros_like, Loss.DARK),
    ("over-exposed", lambda image: cv2.add(image, (245, 245, 245, 0)), Loss.BRIGHT),
    ("covered", lambda image: cv2.GaussianBlur(image, (0, 0), 60) // 2 + 30, Loss.FEATURELESS),
    ("elsewhere", lambda image: _elsewhere(), Loss.UNMATCHED),
]


def _elsewhere() -> np.ndarray:
    """Return what the same room looks like from its other side."""
    T = toy_sequence("loop", 160, world=WORLD).ground_truth.T_world_cam[75]
    return WORLD.view(T)[0]


@pytest.mark.parametrize(("name", "spoil", "loss"), BLIND, ids=[name for name, *_ in BLIND])
def test_images_without_anything_known_are_lost_with_a_reason(
    name: str, spoil: Callable[[np.ndarray], np.ndarray], loss: Loss
) -> None:
    """Test: three frames of 14 are spoiled. Expected: LOST thrice, with the reason, then a pose in the same session."""
    frames, truth = walk(14)
    for i in (5, 6, 7):
        frames[i] = replace(frames[i], image=spoil(frames[i].image))
    odometry = track(frames)
    for one in odometry[5:8]:
        assert (one.outcome, one.quality, one.loss, one.T_odom_cam) == (Outcome.LOST, Quality.LOST, loss, None)
    assert all(one.loss is None for one in (*odometry[:5], *odometry[8:]))
    assert odometry[8].outcome is Outcome.RECOVERED
    assert {one.session for one in odometry} == {0}
    assert 0 < worst_error(odometry, truth) < 0.05


@pytest.mark.parametrize("cover", ["black", "picture"])
def test_a_partly_covered_lens_does_not_hold_the_camera(cover: str) -> None:
    """Test: from frame 4 on 40 % of the image is black, or a picture that never moves.

    Expected: every frame is tracked, and no worse than a few centimetres over 1.6 m.
    """
    frames, truth = walk(18)
    height, width = frames[0].image.shape[:2]
    patch = np.zeros((height, int(0.4 * width), 3), np.uint8)
    if cover == "picture":
        noise = np.random.default_rng(0).integers(0, 255, patch.shape).astype(np.uint8)
        patch = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX)
    for i in range(4, 18):
        image = frames[i].image.copy()
        image[:, : patch.shape[1]] = patch
        frames[i] = replace(frames[i], image=image)
    odometry = track(frames)
    assert set(outcomes(odometry[1:])) <= POSED
    assert {one.session for one in odometry} == {0}
    assert 0 < worst_error(odometry, truth) < 0.05


# Light


def exposed(frame: Frame, gain: float, gamma: float = 1.0, bias: float = 0.0) -> Frame:
    light = np.clip(gain * frame.image.astype(float) / 255, 0, 1) ** gamma
    return replace(frame, image=np.clip(np.rint(255 * light + bias), 0, 255).astype(np.uint8))


LIGHT: list[tuple[str, Callable[[int, Frame], Frame]]] = [
    ("step down", lambda i, frame: exposed(frame, 0.4 if i >= 8 else 1)),
    ("step up", lambda i, frame: exposed(frame, 1.6 if i >= 8 else 1)),
    ("flicker", lambda i, frame: exposed(frame, (0.3, 1.0)[i % 2])),
    ("gamma", lambda i, frame: exposed(frame, 1, (1, 2.0, 0.5)[i // 4 % 3])),
    ("bias", lambda i, frame: exposed(frame, 0.8, bias=(0, 50)[i // 6 % 2])),
]


@pytest.mark.parametrize(("name", "light"), LIGHT, ids=[name for name, _ in LIGHT])
def test_changes_of_exposure_are_tracked_by_flow(name: str, light: Callable[[int, Frame], Frame]) -> None:
    """Test: exposure, gain or gamma change in steps or at every frame. Expected: tracked, never by descriptors."""
    frames, truth = walk(16)
    odometry = track([light(i, frame) for i, frame in enumerate(frames)])
    assert set(outcomes(odometry[1:])) == {Outcome.TRACKED}
    assert 0 < worst_error(odometry, truth) < 0.05
    assert sum(one.keyframe_id is not None for one in odometry) < 8


@pytest.mark.parametrize("gamma", [0.5, 1.0, 2.2])
def test_the_tone_curve_is_the_change_that_was_made(gamma: float) -> None:
    """Expected: the curve between two exposures of one view within 2 grey levels; none between equal ones."""
    image = cv2.cvtColor(WORLD.view(toy_sequence("loop", 160, world=WORLD).ground_truth.T_world_cam[0])[0], 6)
    levels = np.arange(256)
    expected = np.rint(255 * (0.7 * levels / 255) ** gamma).astype(np.uint8)
    curve = tone_curve(image, cv2.LUT(image, expected))
    assert curve is not None
    present = np.bincount(image[::4].ravel(), minlength=256) > 20
    assert present.sum() > 80
    assert np.abs(curve.astype(int) - expected)[present].max() <= 2
    assert tone_curve(image, image) is None
    assert match_tone(image, image) is None
