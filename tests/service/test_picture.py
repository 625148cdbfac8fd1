from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from seamark.frontend.types import Mode
from seamark.service import picture
from seamark.service.config import load_config
from seamark.service.report import build_report
from seamark.service.types import RunRecord

MakeRecord = Callable[..., RunRecord]


def draw(record: RunRecord, path: Path) -> np.ndarray:
    picture.draw_run(record, build_report(record, load_config()), path)
    image = cv2.imread(str(path))
    assert image is not None
    return image


def pixels_of(image: np.ndarray, colour: str) -> int:
    bgr = [int(colour[k : k + 2], 16) for k in (5, 3, 1)]
    return int((np.abs(image.astype(int) - bgr).max(axis=2) <= 8).sum())


@pytest.mark.parametrize("mode", [Mode.RGBD, Mode.MONO])
def test_map_shows_all_four(make_record: MakeRecord, tmp_path: Path, mode: Mode) -> None:
    image = draw(make_record(mode), tmp_path / "map.png")
    assert image.shape[1] == 1260
    for colour in (picture.ODOMETRY, picture.CORRECTED, picture.ACCEPTED):
        assert pixels_of(image, colour) > 50
    without = draw(replace(make_record(mode), ground_truth=None), tmp_path / "without.png")
    grey = pixels_of(image, "#cdd2d6")
    assert grey > 500
    assert pixels_of(without, "#cdd2d6") < grey / 4


def test_ground_truth_lies_on_the_estimate_in_metres(make_record: MakeRecord) -> None:
    for mode in (Mode.RGBD, Mode.MONO):
        paths = picture._paths(make_record(mode))
        assert paths.metric
        assert np.ptp(paths.truth[:, 0]) == pytest.approx(24, abs=0.2)
        gaps = np.linalg.norm(paths.corrected[:, None] - paths.truth[None], axis=2).min(axis=1)
        assert gaps.max() < 0.4
        assert paths.loops.shape == (1, 2, 2)
        assert np.linalg.norm(paths.loops[0, 0] - paths.loops[0, 1]) < 0.1


def test_no_line_across_a_gap() -> None:
    points = np.column_stack([np.arange(10.0), np.zeros(10)])
    points[5:] += 100
    broken = picture._broken(points)
    assert len(broken) == 11
    assert np.isnan(broken[5]).all()
    assert len(picture._broken(points[:5])) == 5


def test_matches_of_places(make_record: MakeRecord, tmp_path: Path) -> None:
    image = draw(make_record(Mode.PLACES), tmp_path / "places.png")
    assert pixels_of(image, picture.ACCEPTED) > 10


def test_a_run_without_poses_still_gets_its_picture(make_record: MakeRecord, tmp_path: Path) -> None:
    record = replace(make_record(Mode.PLACES), mode=Mode.RGBD)
    assert draw(record, tmp_path / "none.png").size > 0
