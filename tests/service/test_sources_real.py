from pathlib import Path

import numpy as np
import pytest

from seamark.frontend.types import Frame, Mode
from seamark.service.evaluation import associate
from seamark.service.sources.open import open_sources

DATA = Path(__file__).parents[3] / "shared" / "data"

pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(not DATA.is_dir(), reason=f"REAL DATA NOT TESTED: {DATA} is missing"),
]


@pytest.mark.parametrize(
    ("folder", "mode", "count", "size"),
    [
        ("tum_fr1_rpy", Mode.RGBD, 357, (480, 640, 3)),
        ("rgbd_hololens", Mode.RGBD, 373, (360, 540, 3)),
        ("kitti06_stereo_000-050", Mode.STEREO, 51, (370, 1226)),
        ("euroc_v101_stereo_keyframes", Mode.STEREO, 100, (480, 752)),
    ],
)
def test_data_sets(folder: str, mode: Mode, count: int, size: tuple[int, ...]) -> None:
    source = open_sources([str(DATA / folder)])
    assert (source.mode, source.n_frames) == (mode, count)
    assert source.rig is not None
    assert source.ground_truth is not None
    assert source.stamps_ns is not None
    assert (np.diff(source.stamps_ns) > 0).all()
    i, _ = associate(source.stamps_ns, source.ground_truth.stamps_ns)
    assert len(i) == count
    frame = next(source.frames())
    assert isinstance(frame, Frame)
    assert frame.image.shape == size
    assert (source.rig.cam0.height, source.rig.cam0.width) == size[:2]
    if mode is Mode.RGBD:
        assert frame.depth is not None
        assert frame.depth.shape == size[:2]
        metres = np.median(frame.depth[frame.depth > 0]) / source.rig.depth_factor
        assert 0.3 < metres < 6
    else:
        assert source.rig.T_cam0_cam1 is not None
        assert frame.image_right is not None
        assert frame.image_right.shape == size
        baseline = {"kitti06_stereo_000-050": 0.5372, "euroc_v101_stereo_keyframes": 0.1101}[folder]
        assert source.rig.T_cam0_cam1[0, 3] == pytest.approx(baseline, abs=1e-4)


def test_gardens_point_one_after_another() -> None:
    source = open_sources([str(DATA / "gardens_point" / side) for side in ("day_left", "day_right")])
    assert (source.mode, source.n_frames, source.rig) == (Mode.PLACES, 400, None)
    got = list(source.frames())
    assert len(got) == 400
    assert all(isinstance(frame, Frame) for frame in got)
    assert got[199].file == "day_left/Image199.jpg"
    assert got[200].file == "day_right/Image000.jpg"
    assert [frame.stamp_ns for frame in got] == [k * 10**9 for k in range(400)]
