"""`seamark serve`: keeps the three nodes alive until it is told to stop."""

import contextlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from seamark.backend.errors import MapUnwritableError
from seamark.backend.map_store import MapStore
from seamark.frontend.types import Mode
from seamark.service.calibration import load_calibration
from seamark.service.config import SeamarkConfig, for_mode
from seamark.service.launcher import Launcher, StartInterruptedError
from seamark.service.nodes.settings import NodeSettings
from seamark.service.sources.base import SourceError, choose, offered
from seamark.service.stop_signal import StopSignal

CHECK_EVERY_S = 0.5

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ServeOptions:
    """What the service is asked for besides the configuration.

    ``calib`` None allows mode places only. ``listen`` is where the own router listens; ``connect``, if given, is the
    router to use instead. ``localise_only``: see :class:`~seamark.service.nodes.settings.NodeSettings`.
    """

    calib: Path | None
    mode: str | None
    map_path: Path
    vocabulary: Path | None
    listen: str
    connect: str | None
    namespace: str
    loops: bool = True
    localise_only: bool = False


def settings_for(options: ServeOptions, config: SeamarkConfig) -> NodeSettings:
    """Return what the nodes are told; raises SeamarkError for a bad calibration or mode."""
    rig = load_calibration(options.calib) if options.calib is not None else None
    modes = offered(rig, stereo=rig is not None and rig.cam1 is not None, depth=rig is not None)
    if options.mode is not None and options.mode not in list(Mode):
        raise SourceError(f"{options.mode!r} is not a mode; there are {', '.join(Mode)}")
    mode = choose(Mode(options.mode) if options.mode else None, modes, "the service")
    return NodeSettings(
        mode=mode,
        rig=rig,
        config=for_mode(config, mode),
        vocabulary=options.vocabulary,
        map_path=options.map_path,
        no_loops=not options.loops,
        endpoint=options.connect or "",
        namespace=options.namespace,
        patient=True,
        localise_only=options.localise_only,
    )


def serve(options: ServeOptions, config: SeamarkConfig, ready: Callable[[str, str], None]) -> None:
    """Start the nodes, call ``ready(endpoint, mode)``, wait for SIGINT or SIGTERM, and stop the nodes in order.

    A signal while they start ends that too.

    Raises NodeFailedError when a node dies more often than it is restarted, SessionError when the endpoint cannot be
    used, and SeamarkError for bad settings.
    """
    settings = settings_for(options, config)
    _look_at(options.map_path, options.localise_only)
    stop = StopSignal()
    with (
        contextlib.suppress(StartInterruptedError),
        Launcher(settings, listen=options.listen, interrupted=lambda: stop.ordered) as launcher,
    ):
        ready(launcher.endpoint, settings.mode)
        while not stop.wait(CHECK_EVERY_S):
            launcher.check()
        logger.info("stopping")


def _look_at(path: Path, localise_only: bool) -> None:
    """Bring a map of an earlier version up to date, and fail at once where the back end would; raises MapError."""
    with contextlib.suppress(MapUnwritableError):  # the service answers from such a map
        if localise_only or path.exists():
            MapStore(path, read_only=localise_only).close()
