"""Synthetic sequences written to a folder in a public layout: resumable after any end, complete or not there at all."""

import contextlib
import fcntl
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO

import numpy as np

from seamark import SeamarkError
from seamark.datasets_synth import (
    fallback,
    folder,
    layouts,
    motion_sensors,
    people,
    scenarios,
    sensor,
    specification,
    toy,
    toy_names,
)
from seamark.datasets_synth import trajectory as stamping
from seamark.datasets_synth.clearance import require_clear
from seamark.datasets_synth.layouts import Recording
from seamark.datasets_synth.motion_sensors import Motion, read_gps, read_imu, read_wheels
from seamark.datasets_synth.rendering import RenderPool, require_renderer
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.scenario import cache_folder
from seamark.datasets_synth.sensor import CodedFrame
from seamark.datasets_synth.sequence import GroundTruth
from seamark.datasets_synth.specification import Specification
from seamark.datasets_synth.toy_names import ToySpecification
from seamark.datasets_synth.trajectories import teleports
from seamark.frontend.camera import Rig
from seamark.frontend.types import Frame, Mode

IDENTITY = "synth.json"  # in a finished folder: what it holds
COUNT, LOCK = "frames.done", "lock"  # only while it is being written
TELEPORT_FACTOR = 3.0  # times the pace of the route

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Written:
    """What lies in ``folder`` now; ``resumed`` of the ``frames`` had been there before."""

    folder: Path
    name: str
    layout: str
    frames: int
    resumed: int


@dataclass(frozen=True, eq=False)
class _Plan:
    """A sequence that has not been made yet: ``coded`` yields its frames from an index on, ``people`` their table."""

    name: str
    mode: Mode
    rig: Rig
    truth: GroundTruth
    sensor: str
    seed: int
    breaks: list[int]
    coded: Callable[[int], Iterator[CodedFrame]]
    digest: str
    people: Callable[[], str] = str

    def recording(self) -> Recording:
        """Return the readings of all sensors but the cameras."""
        errors = motion_sensors.MODELS[self.sensor]
        motion = Motion(self.truth.stamps_ns, self.truth.T_world_cam, self.breaks)
        readings = (
            read_imu(motion, errors.imu, self.seed),
            read_wheels(motion, errors.wheels, self.seed),
            read_gps(motion, errors.gps, self.seed),
        )
        title = f"seamark synth:{self.name}"
        return Recording(title, self.mode, self.rig, self.truth, motion, errors, *readings)


def write_sequence(
    spec: str, layout_name: str, target: Path, progress: Progress | None = None, *, cache_dir: Path | None = None
) -> Written:
    """Write the sequence ``NAME[,key=value...]`` to ``target`` in the layout tum, euroc or kitti.

    ``progress`` is called with frames done and in all. Frames are kept beside the target in a hidden folder until all
    is complete; after an interruption the same call goes on where the last one ended, and on a complete target it does
    nothing. Raises SeamarkError where names are unknown, the layout cannot carry the sensors, or the target holds
    something else, and NoVulkanDevice where frames would have to be rendered and nothing can render.
    """
    plan = _plan(spec, cache_dir)
    layout = layouts.require(layout_name, plan.mode, plan.rig)
    identity = json.dumps({"synth": plan.name, "layout": layout_name, "content": plan.digest}, indent=2) + "\n"
    total = len(plan.truth)
    try:
        if _complete(target, identity):
            return Written(target, plan.name, layout_name, total, total)
        with _staging(target, identity) as (partial, begin):
            for coded in plan.coded(begin) if begin < total else ():
                for name, content in layout.frame(coded, int(plan.truth.stamps_ns[coded.index])).items():
                    _put(partial / name, content)
                if coded.labels:
                    _put(partial / folder.labels_name(coded.index), coded.labels)
                _put(partial / COUNT, str(coded.index + 1).encode())
                if progress is not None:
                    progress(coded.index + 1, total)
            layout.finish(partial, plan.recording())
            if walking := plan.people():
                _put(partial / "labels" / "people.csv", walking.encode())
            (partial / LOCK).unlink()
            partial.rename(target)
            (target / COUNT).unlink()
    except OSError as error:
        raise SeamarkError(f"{target} cannot be written: {error}") from error
    return Written(target, plan.name, layout_name, total, begin)


def _complete(target: Path, identity: str) -> bool:
    """Tell whether the target holds this sequence already; raises SeamarkError where it holds something else."""
    if (target / IDENTITY).is_file() and (target / IDENTITY).read_text(encoding="utf-8") == identity:
        return True
    if target.is_file() or (target.is_dir() and any(target.iterdir())):
        raise SeamarkError(f"{target} holds something else already; give a folder that does not exist yet")
    return False


@contextlib.contextmanager
def _staging(target: Path, identity: str) -> Iterator[tuple[Path, int]]:
    """Yield the folder in which a sequence grows, locked, and how many frames it has already."""
    partial = target.absolute().with_name(f".{target.absolute().name}.partial")
    partial.mkdir(parents=True, exist_ok=True)
    with (partial / LOCK).open("w") as lock:
        _take(lock, target)
        known = partial / IDENTITY
        if not known.is_file() or known.read_text(encoding="utf-8") != identity:
            for path in partial.iterdir():  # left by another sequence
                if path.name != LOCK:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
            _put(known, identity.encode())
        count = partial / COUNT
        try:
            yield partial, int(count.read_text()) if count.is_file() else 0
        finally:
            if partial.is_dir() and not count.is_file():  # not one frame was made
                shutil.rmtree(partial, ignore_errors=True)


def _take(lock: IO[str], target: Path) -> None:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise SeamarkError(f"{target} is being written by another process") from None


def _put(file: Path, content: bytes) -> None:
    """Write a file so that it is there completely or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    fresh = file.with_name(f".{file.name}.new")
    fresh.write_bytes(content)
    fresh.replace(file)


def _plan(spec: str, cache_dir: Path | None) -> _Plan:
    text = scenarios.expand(spec)
    if text.split(",")[0].strip() == fallback.NAME:
        raise SeamarkError(f"{fallback.NAME} is kept in layout tum at {fallback.small_loop_path()}")
    return _plan_toy(toy_names.parse(text)) if toy_names.is_toy(text) else _plan_world(text, cache_dir)


def _breaks(kind: str, route: Route, truth: GroundTruth) -> list[int]:
    if kind != "kidnap":
        return []
    return teleports(truth.T_world_cam, specification.FPS, TELEPORT_FACTOR * route.speed_m_s)


def _plan_world(text: str, cache_dir: Path | None) -> _Plan:
    wanted = specification.parse(text)
    truth = GroundTruth(stamping.stamps(wanted.frames, specification.FPS), wanted.poses())
    finished = cache_folder(wanted, cache_dir)
    if not finished.is_dir():
        require_clear(wanted)

    def coded(begin: int) -> Iterator[CodedFrame]:
        if finished.is_dir():
            yield from (folder.read_coded(finished, index) for index in range(begin, wanted.frames))
            return
        require_renderer()
        with RenderPool(wanted, begin) as pool:
            yield from pool.frames()

    def walking() -> str:
        return people.table(people.people_of(wanted), truth.stamps_ns) if wanted.labels else ""

    return _Plan(
        name=_canonical(wanted, wanted.world),
        mode=wanted.mode,
        rig=wanted.rig,
        truth=truth,
        sensor=wanted.sensor,
        seed=wanted.motion_seed,
        breaks=_breaks(wanted.trajectory, wanted.route, truth),
        coded=coded,
        digest=specification.content_hash(wanted),
        people=walking,
    )


def _plan_toy(wanted: ToySpecification) -> _Plan:
    sequence = wanted.open()
    rig = Rig(sequence.rig.cam0, sequence.rig.cam1, sequence.rig.T_cam0_cam1, sensor.DEPTH_FACTOR)

    def coded(begin: int) -> Iterator[CodedFrame]:
        world = toy.ToyWorld(wanted.seed)
        for index in range(begin, wanted.frames):
            yield _code(world.render(sequence.ground_truth.T_world_cam[index], index, sensors=sequence.mode))

    name = _canonical(wanted, toy_names.NAME)
    digest = hashlib.sha256(name.encode())
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return _Plan(
        name=name,
        mode=sequence.mode,
        rig=rig,
        truth=sequence.ground_truth,
        sensor=wanted.sensor,
        seed=wanted.seed,
        breaks=_breaks(wanted.trajectory, toy.route(), sequence.ground_truth),
        coded=coded,
        digest=digest.hexdigest()[:16],
    )


def _canonical(wanted: Specification | ToySpecification, world: str) -> str:
    """Return the name with every setting, in the order of their fields."""
    return scenarios.join(world, {key: str(value) for key, value in asdict(wanted).items() if key != "world"})


def _code(frame: Frame) -> CodedFrame:
    right = b"" if frame.image_right is None else sensor.code_picture(frame.image_right)
    depth = b""
    if frame.depth is not None:
        depth = sensor.code_depth(np.rint(frame.depth * sensor.DEPTH_FACTOR).astype(np.uint16))
    return CodedFrame(frame.index, sensor.code_picture(frame.image), right, depth)
