"""`seamark run`: a source through the three nodes, from the first frame to the written results."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from seamark.backend.errors import MapError
from seamark.backend.map_store import MapStore
from seamark.backend.types import MapSnapshot
from seamark.frontend.types import Frame, Mode, Odometry
from seamark.service import topics
from seamark.service.bus import DRAIN_TIMEOUT_S
from seamark.service.config import SeamarkConfig, for_mode
from seamark.service.frame_window import FrameWindow, Nodes, ask
from seamark.service.launcher import Launcher
from seamark.service.local_nodes import LocalNodes, own_usage
from seamark.service.nodes.settings import NodeSettings
from seamark.service.output import Output, prepare_output
from seamark.service.recorder import NullRecorder, Recorder, RerunRecorder
from seamark.service.requests import Status
from seamark.service.results import write_files
from seamark.service.sources.base import Source, SourceError, Unreadable
from seamark.service.types import KeyframeSummary, ProcessUsage, RunRecord

MAP_FILE = "map.seamark"
RECORDING_FILE = "run.rrd"
PASSING_FILE = "passing.seamark"  # keyframes of a run that leaves no map, until it ends
NO_TRACKS = np.zeros((0, 4), np.float32)

Progress = Callable[[int, int | None, Odometry], None]


@dataclass(frozen=True)
class RunOptions:
    """What a run is asked for, besides its source and the configuration.

    ``in_process`` puts the nodes on a LocalBus, so that two runs give equal trajectories and tables. ``realtime`` sends
    frames no faster than their stamps say. ``vocabulary`` None is the one that ships with Seamark. ``sources`` are
    named in the report. ``map_path`` is a map to go on with: the run works on a copy in ``out`` and leaves it as it is;
    with ``localise_only`` it makes none, finds the frames' poses in that map, and leaves no map.
    """

    out: Path
    sources: tuple[str, ...]
    vocabulary: Path | None = None
    loops: bool = True
    in_process: bool = False
    realtime: bool = False
    map_path: Path | None = None
    localise_only: bool = False


def run(source: Source, options: RunOptions, config: SeamarkConfig, progress: Progress | None = None) -> RunRecord:
    """Run a source through the nodes and write all results; returns what was found.

    Nothing appears in the folder unless the run ends well. Raises a SeamarkError for bad input, a bad configuration or
    a folder that cannot be written to.
    """
    with prepare_output(options.out) as output:
        map_path = output.staging / MAP_FILE
        if options.localise_only:
            if options.map_path is None:
                raise MapError("to localise only, a map is needed")
            map_path = options.map_path
        elif options.map_path is not None:
            with MapStore(options.map_path, read_only=True) as store:
                store.copy(map_path)
        settings = NodeSettings(
            mode=source.mode,
            rig=source.rig,
            config=for_mode(config, source.mode),
            vocabulary=options.vocabulary,
            map_path=map_path,
            no_loops=not options.loops,
            localise_only=options.localise_only,
            passing_path=output.staging / PASSING_FILE if options.localise_only else None,
            solver_process=not options.in_process,
        )
        record = _run_nodes(source, options, settings, output, progress)
        for passing in output.staging.glob(f"{PASSING_FILE}*"):
            passing.unlink()
        write_files(record, output.staging, settings.config)
        output.commit()
    return record


def _run_nodes(
    source: Source, options: RunOptions, settings: NodeSettings, output: Output, progress: Progress | None
) -> RunRecord:
    with ExitStack() as stack:
        recorder = _recorder(source, settings.config, output)
        stack.callback(recorder.close)
        nodes = _start(settings, in_process=options.in_process)
        stack.enter_context(nodes)
        started = time.monotonic()
        odometry = _send_all(source, nodes, options, settings.config, recorder, progress)
        for node in topics.NODES:
            ask(nodes, topics.DRAIN[node], DRAIN_TIMEOUT_S)
        wall_s = time.monotonic() - started
        snapshot: MapSnapshot = ask(nodes, topics.MAP_SNAPSHOT)
        statuses = {node: ask(nodes, topics.STATUS[node]) for node in topics.NODES}
        usage = _usage(nodes.stop(), statuses)

        record = RunRecord(
            sources=options.sources,
            mode=source.mode,
            odometry=odometry,
            keyframes=_passed(odometry) if options.localise_only else _keyframes(output.staging / MAP_FILE, recorder),
            snapshot=snapshot,
            ground_truth=source.ground_truth,
            processes=usage,
            wall_s=wall_s,
            stages_ms=_stages(statuses),
            deterministic=options.in_process,
            known=_known(options.map_path) if options.localise_only and options.map_path is not None else (),
        )
        recorder.finish(record)
    return record


def _start(settings: NodeSettings, *, in_process: bool) -> Nodes:
    return LocalNodes(settings) if in_process else Launcher(settings)


def _recorder(source: Source, config: SeamarkConfig, output: Output) -> Recorder:
    if not config.service.record:
        return NullRecorder()
    return RerunRecorder(
        output.staging / RECORDING_FILE,
        name=source.name,
        mode=source.mode,
        rig=source.rig,
        image_px=config.service.recording_image_px,
        jpeg_quality=config.service.recording_jpeg_quality,
    )


def _send_all(
    source: Source,
    nodes: Nodes,
    options: RunOptions,
    config: SeamarkConfig,
    recorder: Recorder,
    progress: Progress | None,
) -> tuple[Odometry, ...]:
    """Send every frame and return what the front end said of each."""
    window = FrameWindow(nodes, config.service.frame_window)
    answered: list[Odometry] = []

    def take(pairs: Iterator[tuple[Frame | Unreadable, Odometry]]) -> None:
        for frame, odometry in pairs:
            recorder.frame(frame, odometry)
            # The tracks were for the recording: of a day's frames they would fill the memory.
            answered.append(replace(odometry, tracks=NO_TRACKS))
            if progress is not None:
                progress(len(answered), source.n_frames, odometry)

    checked = False
    reason = ""
    pace = Pace() if options.realtime else None
    for frame in source.frames():
        if isinstance(frame, Frame) and not checked:
            check_size(frame, source)
            checked = True
        if isinstance(frame, Unreadable):
            reason = reason or f" ({frame.reason})"
        if pace is not None:
            pace.wait(frame.stamp_ns)
        take(window.push(frame))
    take(window.drain())
    if not checked:
        raise SourceError(f"{source.name}: not one of {len(answered)} images can be read{reason}")
    return tuple(answered)


def check_size(frame: Frame, source: Source) -> None:
    """Raise SourceError if the first image contradicts the calibration; later ones are counted frame by frame."""
    if source.rig is None or source.mode is Mode.PLACES:
        return
    camera = source.rig.cam0
    pictures = {"": frame.image, "the right image of ": frame.image_right, "the depth image of ": frame.depth}
    for what, picture in pictures.items():
        if picture is not None and picture.shape[:2] != (camera.height, camera.width):
            height, width = picture.shape[:2]
            raise SourceError(
                f"{source.name}: {what}{frame.file} has {width} x {height} pixels,"
                f" but the calibration is for {camera.width} x {camera.height}"
            )


class Pace:
    """Holds frames back until as much time has passed as between their stamps."""

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None

    def wait(self, stamp_ns: int) -> None:
        """Sleep until the frame with this stamp is due."""
        now = time.monotonic()
        if self._first is None:
            self._first = now, stamp_ns
        due = self._first[0] + 1e-9 * (stamp_ns - self._first[1])
        if due > now:
            time.sleep(due - now)


def _stages(statuses: dict[str, Status]) -> dict[str, list[float]]:
    return {
        f"{node}.{stage}": latencies
        for node, status in statuses.items()
        for stage, latencies in status.stages_ms.items()
        if node != topics.FRONTEND  # its stages come with every frame
    }


def _usage(ended: tuple[ProcessUsage, ...], statuses: dict[str, Status]) -> tuple[ProcessUsage, ...]:
    """Return what all processes have used: CPU time from their end, memory from what they said of themselves.

    The kernel's own peak of a child starts with the memory of the parent that it was forked from.
    """
    nodes = [ProcessUsage(one.name, statuses[one.name].peak_rss_bytes, one.cpu_s) for one in ended]
    return (*nodes, own_usage())


def _passed(odometry: tuple[Odometry, ...]) -> tuple[KeyframeSummary, ...]:
    """Return the keyframes of a run that leaves no map."""
    files = {one.index: one.file for one in odometry}
    passed = []
    for one in odometry:
        if one.filled:  # the first view of a mono session became a keyframe afterwards
            first = one.filled[0]
            passed.append(
                KeyframeSummary(first.reference_id, first.session, first.index, first.stamp_ns, files[first.index])
            )
        if one.keyframe_id is not None:
            passed.append(KeyframeSummary(one.keyframe_id, one.session, one.index, one.stamp_ns, one.file))
    return tuple(passed)


def _known(map_path: Path) -> tuple[KeyframeSummary, ...]:
    """Return the keyframes of a map, which is left as it is."""
    with MapStore(map_path, read_only=True) as store:
        return tuple(KeyframeSummary(k.id, k.session, k.index, k.stamp_ns, k.file) for k in store.load_nodes())


def _keyframes(map_path: Path, recorder: Recorder) -> tuple[KeyframeSummary, ...]:
    """Read the keyframes back from the finished map, and show them to the recorder."""
    summaries = []
    with MapStore(map_path) as store:  # not read_only: that would leave SQLite's side files behind
        for keyframe in store.load_keyframes():
            recorder.keyframe(keyframe)
            summaries.append(
                KeyframeSummary(keyframe.id, keyframe.session, keyframe.index, keyframe.stamp_ns, keyframe.file)
            )
    return tuple(summaries)
