"""Odometry as a witness: what it allows, and that it alone tells a place from its copy before both are known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from seamark.frontend.config import FrontendConfig
from seamark.service.places_images import DescribedImage, describe_image
from seamark.service.places_motion import AGREES, CONTRADICTS, NO_SESSION, UNKNOWN, Motion, follow
from seamark.service.places_search import STREAK, search_own
from seamark.service.sources.open import open_sources
from seamark.vocab.confidence import Verdict
from seamark.vocab.config import VocabConfig
from seamark.vocab.vocabulary import Vocabulary


def straight(x_m: list[float], sessions: list[int] | None = None, *, metric: bool = True) -> Motion:
    poses = np.tile(np.eye(4), (len(x_m), 1, 1))
    poses[:, 0, 3] = x_m
    return Motion(poses, np.array(sessions or [0] * len(x_m)), metric)


def test_what_lies_within_a_view_and_the_drift_agrees() -> None:
    there_and_back = straight([0, 20, 40, 20, 2.7, 0.5])
    # 2.7 m agree after 77.3 m, where 2 + 0.01 * 77.3 = 2.77, and not after 37.3.
    assert there_and_back.judge(4, np.array([0, 1, 2])).tolist() == [AGREES, CONTRADICTS, CONTRADICTS]
    assert there_and_back.judge(5, np.array([0, 1, 3])).tolist() == [AGREES, CONTRADICTS, CONTRADICTS]
    assert straight([0, 20, 2.7]).judge(2, np.array([0])).tolist() == [CONTRADICTS]


def test_a_camera_that_looks_back_sees_another_place() -> None:
    motion = straight([0, 1, 0, 0])
    for number, degrees in ((2, 35), (3, 45)):
        motion.T_odom_cam[number, :3, :3] = cv2.Rodrigues(np.array([0, np.deg2rad(degrees), 0]))[0]
    assert [motion.judge(i, np.array([0]))[0] for i in (2, 3)] == [AGREES, CONTRADICTS]


def test_poses_of_other_sessions_or_none_say_nothing() -> None:
    motion = straight([0, 50, 50, 50], [0, 0, 1, NO_SESSION])
    assert motion.judge(2, np.array([0, 1, 3])).tolist() == [UNKNOWN] * 3
    assert motion.judge(3, np.array([0, 1, 2])).tolist() == [UNKNOWN] * 3
    assert motion.judge(1, np.array([0])).tolist() == [CONTRADICTS]
    # The jump from one session to the next is no way: without it 2.1 m are too far after 2.1 m.
    jump = straight([0, 0.5, 900, 0.5, 2.1], [0, 0, 1, 0, 0])
    assert jump.judge(4, np.array([0])).tolist() == [CONTRADICTS]


def test_without_scale_a_tenth_of_the_way_agrees() -> None:
    motion = straight([0, 0.5, 1.0, 0.19, 0.17], metric=False)
    assert motion.judge(3, np.array([0])).tolist() == [CONTRADICTS]  # 0.19 after 1.81
    assert motion.judge(4, np.array([0])).tolist() == [AGREES]  # 0.17 after 1.83


@pytest.fixture(scope="module")
def walk() -> tuple[list[DescribedImage], list[float]]:
    """Six places, four that look like the first four and lie 30 m on, four others, and the first four again."""

    def image(seed: int, shift: int) -> NDArray[np.uint8]:
        rng = np.random.default_rng(seed)
        canvas = np.full((260, 420, 3), rng.integers(60, 200, 3), np.uint8)
        for _ in range(60):
            x, y, w, h = (int(v) for v in rng.integers((0, 0, 5, 5), (400, 240, 70, 70)))
            cv2.rectangle(canvas, (x, y), (x + w, y + h), rng.integers(0, 256, 3).tolist(), -1)
        return canvas[10:250, 20 + shift : 380 + shift]

    seeds = [0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 10, 11, 12, 13, 0, 1, 2, 3]
    x = [0, 2, 4, 6, 8, 10, 30, 32, 34, 36, 50, 52, 54, 56, 0.3, 2.3, 4.3, 6.3]
    described = [describe_image(image(seed, n % 5), str(n), FrontendConfig()) for n, seed in enumerate(seeds)]
    return described, [float(value) for value in x]


@pytest.mark.parametrize("in_order", [False, True])
def test_a_copy_is_refused_and_the_place_itself_found(
    walk: tuple[list[DescribedImage], list[float]], in_order: bool
) -> None:
    images, x = walk
    config = VocabConfig(exclude_recent_s=0.0, exclude_recent_count=4)
    stamps, vocabulary = [10**9 * n for n in range(len(images))], Vocabulary.default()

    def ask(motion: Motion | None) -> list[int]:
        answers, _ = search_own(images, stamps, vocabulary, config, top=3, in_order=in_order, workers=1, motion=motion)
        for answer in answers:
            assert all(not match.accepted for match in answer.matches[1:])
            assert (answer.verdict is Verdict.ACCEPTED) == any(match.accepted for match in answer.matches)
        return [answer.matches[0].place if answer.matches and answer.matches[0].accepted else -1 for answer in answers]

    if not in_order:
        assert ask(None)[6:10] == [0, 1, 2, 3]  # by looks alone each copy is believed
    found = ask(straight(x))
    assert found[:14] == [-1] * 14
    first = STREAK - 1 if in_order else 0
    assert found[14 + first :] == [0, 1, 2, 3][first:]
    unknown = straight(x)
    unknown = replace(unknown, sessions=np.full(len(x), NO_SESSION))
    assert ask(unknown) == ask(None)


def test_where_odometry_contradicts_every_place_the_answer_says_so(
    walk: tuple[list[DescribedImage], list[float]],
) -> None:
    images, x = walk
    config = VocabConfig(exclude_recent_s=0.0, exclude_recent_count=4)
    stamps = [10**9 * n for n in range(10)]
    answers, _ = search_own(
        images[:10], stamps, Vocabulary.default(), config, top=3, in_order=False, workers=1, motion=straight(x[:10])
    )
    assert [answer.verdict for answer in answers[6:]] == [Verdict.ELSEWHERE] * 4
    assert all(answer.probability == 0 and len(answer.matches) == 3 for answer in answers[7:])


def test_the_front_end_is_followed_and_a_source_without_calibration_is_not() -> None:
    assert follow(open_sources(["synth:small_loop"], mode="places"), FrontendConfig()) is None
    source = open_sources(["synth:small_loop"], mode="rgbd")
    motion = follow(source, FrontendConfig())
    assert motion is not None and motion.metric and source.ground_truth is not None
    known = motion.sessions != NO_SESSION
    assert known.mean() > 0.95 and len(motion.sessions) == source.n_frames
    true = source.ground_truth.T_world_cam[:, :3, 3]
    said = motion.T_odom_cam[:, :3, 3]
    between = np.linalg.norm(true[-1] - true[0]), np.linalg.norm(said[-1] - said[0])
    assert between[1] == pytest.approx(between[0], abs=0.2)
    assert motion.judge(source.n_frames - 1, np.arange(source.n_frames - 1)).min() == CONTRADICTS
