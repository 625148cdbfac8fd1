"""What a node's process is told when it starts."""

from dataclasses import dataclass, field
from pathlib import Path

from seamark.frontend.types import Mode, Rig
from seamark.service.config import SeamarkConfig, load_config


@dataclass(frozen=True, eq=False)
class NodeSettings:
    """Settings of all three nodes; can be pickled.

    ``vocabulary`` None is the one that ships with Seamark. ``map_path`` None keeps the map in memory only.
    ``first_keyframe_id`` and ``first_session`` let a front end that was restarted go on counting. ``solver_process``
    puts the pose graph's solver into a process of its own, so that queries stay answered while it works. ``restore``
    tells the vocabulary that there is a map to take places from; the back end, which owns the file, always looks.
    ``localise_only`` opens the map for reading and leaves it as it is: queries are answered, nothing is learned.
    With ``passing_path`` sessions in such a map get poses in it nevertheless: what is learned of them is kept in that
    file, which is nobody's map, and survives a node that dies. ``patient`` lets the back end wait for a disk that takes
    no more, where a run would end.
    """

    mode: Mode
    rig: Rig | None = None
    config: SeamarkConfig = field(default_factory=load_config)
    vocabulary: Path | None = None
    map_path: Path | None = None
    no_loops: bool = False
    endpoint: str = ""
    namespace: str = "default"
    first_keyframe_id: int = 0
    first_session: int = 0
    solver_process: bool = True
    restore: bool = False
    patient: bool = False
    localise_only: bool = False
    passing_path: Path | None = None
    log_level: str = "WARNING"
