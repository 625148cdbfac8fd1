"""A writer is killed hundreds of times at random moments; nothing that it had acknowledged is ever missing."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from seamark.backend.map_check import check_map
from seamark.backend.map_store import MapStore
from seamark.frontend.types import Keyframe

LIVES = 220
KEPT = 20  # keyframes, by map_writer.py
MIGRATIONS = 40
GOLDEN = Path(__file__).parent / "golden" / "map_v1.seamark"
Life = Callable[[], dict[str, object]]


@contextmanager
def killer(path: Path, seed: int) -> Iterator[Life]:
    command = [sys.executable, str(Path(__file__).with_name("map_writer.py")), str(path), str(seed)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None and process.stdout is not None

        def life() -> dict[str, object]:
            process.stdin.write("\n")
            process.stdin.flush()
            outcome: dict[str, object] = json.loads(process.stdout.readline())
            return outcome

        yield life
        process.stdin.close()


def writer_module() -> Callable[[int], Keyframe]:
    import importlib.util

    spec = importlib.util.spec_from_file_location("map_writer", Path(__file__).with_name("map_writer.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    made: Callable[[int], Keyframe] = module.keyframe
    return made


def assert_composed(store: MapStore, oldest: int) -> None:
    """The oldest keyframe begins its chain, and the two loops of its predecessor have become one of their far ends."""
    assert store.keyframe(oldest).previous_id is None
    means = store.load_means()
    loops = {(loop.query_id, loop.match_id): loop for loop in store.load_loops()}
    assert set(means) <= set(loops)
    composed = loops[oldest + 2, oldest]
    assert (oldest + 2, oldest) in means and composed.accepted
    assert 1.5 < composed.covariance[0, 0] <= 2.0 + 1e-9  # two loops of variance 1, one of which may be a mean


def assert_is(found: Keyframe, made: Keyframe) -> None:
    assert (found.session, found.stamp_ns, found.previous_id) == (made.session, made.stamp_ns, made.previous_id)
    np.testing.assert_array_equal(found.T_odom_cam, made.T_odom_cam)
    np.testing.assert_array_equal(found.covariance, made.covariance)
    assert found.jpeg == made.jpeg
    np.testing.assert_array_equal(found.features.descriptors, made.features.descriptors)
    np.testing.assert_array_equal(found.landmarks, made.landmarks)


def test_kills_at_random_moments_lose_nothing_acknowledged(tmp_path: Path) -> None:
    """Test: 220 lives, too short for more than a few writes, from the creation of the file on.

    Expected: after each, all that was acknowledged is there to the bit; at the end the file is whole.
    """
    path, made = tmp_path / "map.seamark", writer_module()
    acknowledged: set[int] = set()
    busy, count, n_before, adjusted = 0, 0, 0, 0
    with killer(path, seed=6) as life:
        for _ in range(LIVES):
            outcome = life()
            numbers: list[int] = outcome["numbers"]  # type: ignore[assignment]
            assert outcome["killed"]
            busy += len(numbers) > 0
            acknowledged |= set(numbers)
            if not path.exists():
                continue
            with MapStore(path) as store:
                ids = store.keyframe_ids()
                newest = max(ids, default=-1)
                assert ids == list(range(newest + 1 - len(ids), newest + 1))
                assert min(newest + 1, KEPT) <= len(ids) <= max(KEPT, n_before) + 1  # killed between add and forget
                assert {number for number in acknowledged if number > newest - KEPT} <= set(ids)
                assert count + len(numbers) <= newest + 1 <= count + len(numbers) + 1
                for number in ids[1:]:
                    assert_is(store.keyframe(number), made(number))
                if len(ids) == KEPT and {ids[0], ids[2]} <= acknowledged and ids[0] > 3:
                    assert_composed(store, ids[0])
                assert int(store.meta().get("mapped", 0)) >= max(acknowledged, default=0)
                # The newest adjustment is as new as the poses: both were written at once. Each is whole.
                moments = [{pose.T_map_cam[0, 3] for pose in one.poses.values()} for one in store.load_adjustments()]
                assert all(len(moment) == 1 for moment in moments)
                assert not moments or max(set.union(*moments)) == int(store.meta()["revision"])
                adjusted += len(moments) > 0
                count, n_before = newest + 1, len(ids)
    assert busy > LIVES / 4 and len(acknowledged) > LIVES / 2 and adjusted > LIVES / 4
    assert check_map(path).problems == ()
    with MapStore(path) as store:
        loops = store.load_loops()
        kept = set(store.keyframe_ids())
        assert {loop.query_id for loop in loops} >= acknowledged & kept - {min(kept)}
        assert all(loop.inliers in (loop.query_id, loop.query_id + 1, loop.query_id - 1) for loop in loops)
        poses = store.load_poses()
        for number in acknowledged & kept:
            pose = poses[number][0] if number % 5 == 0 else None
            assert pose is None or pose[0, 3] in (number, number + 5, number + 10)


def test_kills_while_an_old_file_is_brought_up_to_date_leave_an_old_or_a_new_one(tmp_path: Path) -> None:
    made_whole = 0
    path = tmp_path / "map.seamark"
    with killer(path, seed=7) as life:
        for _ in range(MIGRATIONS):
            for leftover in tmp_path.iterdir():
                leftover.unlink()
            shutil.copy(GOLDEN, path)
            outcome = life()
            made_whole += bool(outcome["open"])
            with MapStore(path) as store:
                found = store.keyframe_ids()
                assert found[:4] == [0, 1, 2, 3]
                assert [k.file for k in store.load_keyframes()][:4] == [f"cam0/{n}.png" for n in range(4)]
                assert len(store.load_loops()) >= 2
            assert check_map(path).problems == ()
    assert made_whole > MIGRATIONS / 5
