"""Names of synthetic sequences: ``loop,frames=400,seed=3,sensors=rgbd`` and what they stand for."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark import SeamarkError
from seamark.datasets_synth import lighting, optics, sensor, trajectories, world_loop
from seamark.datasets_synth.route import Route
from seamark.datasets_synth.world import World
from seamark.datasets_synth.worlds import WORLDS
from seamark.frontend import se3
from seamark.frontend.camera import Camera, Rig
from seamark.frontend.types import Mode

SIZES = ("full", "small")
# Modules that rendered files do not depend on; all others are part of the content hash.
CHANGE_NO_PICTURE = frozenset(
    {"__init__", "toy", "imagery", "fallback", "scenario", "scenarios", "sequence", "rendering", "layouts", "staging"}
    | {"motion_sensors", "ground_truth", "writing", "toy_names", "clearance"}
)
LAP = "lap"  # the trajectory that the world loop has always had, and no other world
TRAJECTORIES = (LAP, *trajectories.KINDS)
IMAGES = {"640x480": (640, 480), "320x240": (320, 240)}
SENSORS = (Mode.RGBD, Mode.STEREO, Mode.MONO)
FRAMES = (2, 5000)
MOST_MOVERS = 3
MOST_CROWD = 40  # per cent of the picture
OFFSET_CM = (-100, 100)
RUNS = 99
FPS = 15.0
FOCAL_PER_WIDTH = 0.640625  # 410 px at a width of 640: 76 degrees wide
BASELINE_M = 0.12


@dataclass(frozen=True)
class Specification:
    """One synthetic sequence, complete: the same specification gives the same bits on one machine.

    ``seed`` draws the world; ``run`` above 0 draws another motion, other people and other noise in the same world.
    ``offset`` shifts the camera to its left by so many cm along the whole trajectory. ``movers`` people walk about;
    ``crowd`` is the share of the picture in per cent that people come to hide, as many as that takes. ``labels`` adds
    labels to what a worker sends, 1 of people, 2 of their parts (figures.label); it changes nothing else.
    """

    world: str
    frames: int = 600
    seed: int = 0
    sensors: str = Mode.RGBD.value
    size: str = "full"
    image: str = "640x480"
    sensor: str = "mild"
    trajectory: str = LAP
    condition: str = "day"
    camera: str = "ideal"
    movers: int = 0
    offset: int = 0
    run: int = 0
    labels: int = 0
    crowd: int = 0

    @property
    def motion_seed(self) -> int:
        """Return the seed of all that differs from run to run: motion, people, noise."""
        return self.seed + 1_000_003 * self.run

    @property
    def route(self) -> Route:
        """Return the way through the world."""
        return WORLDS[self.world].route(self.size)

    @property
    def mode(self) -> Mode:
        """Return the richest mode that the sensors allow."""
        return Mode(self.sensors)

    @property
    def rig(self) -> Rig:
        """Return the calibration of the sensors."""
        width, height = IMAGES[self.image]
        focal = FOCAL_PER_WIDTH * width
        distortion = optics.MODELS[self.camera].distortion
        camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, distortion)
        if self.mode is Mode.STEREO:
            return Rig(camera, camera, se3.make(np.eye(3), np.array([BASELINE_M, 0, 0])))
        return Rig(camera, depth_factor=sensor.DEPTH_FACTOR)

    def build(self) -> World:
        """Return the world."""
        return WORLDS[self.world].build(self.size, self.seed, self.run)

    def poses(self) -> NDArray[np.float64]:
        """Return T_world_cam (N, 4, 4); raises SeamarkError where the world's route does not allow the trajectory."""
        if self.trajectory == LAP:
            poses = world_loop.loop_poses(world_loop.PLANS[self.size], self.frames, self.motion_seed)
        else:
            poses = trajectories.make_trajectory(self.trajectory, self.route, self.frames, FPS, self.motion_seed)
        if self.offset:
            poses = poses @ se3.make(np.eye(3), np.array([-self.offset / 100, 0, 0]))
        return poses


def _choice(options: tuple[str, ...]) -> Callable[[str, str], str]:
    def parse(key: str, text: str) -> str:
        if text not in options:
            raise SeamarkError(f"synthetic sequences know no {key}={text}; there are {', '.join(options)}")
        return text

    return parse


def _number(low: int, high: int) -> Callable[[str, str], int]:
    def parse(key: str, text: str) -> int:
        if not text.removeprefix("-").isdecimal() or not low <= int(text) <= high:
            raise SeamarkError(f"{key} of a synthetic sequence is a whole number from {low} to {high}, not {text!r}")
        return int(text)

    return parse


PARSERS: dict[str, Callable[[str, str], str | int]] = {
    "frames": _number(*FRAMES),
    "seed": _number(0, 2**31 - 1),
    "sensors": _choice(tuple(mode.value for mode in SENSORS)),
    "size": _choice(SIZES),
    "image": _choice(tuple(IMAGES)),
    "sensor": _choice(tuple(sensor.MODELS)),
    "trajectory": _choice(TRAJECTORIES),
    "condition": _choice(lighting.CONDITIONS),
    "camera": _choice(tuple(optics.MODELS)),
    "movers": _number(0, MOST_MOVERS),
    "offset": _number(*OFFSET_CM),
    "run": _number(0, RUNS),
    "labels": _number(0, 2),
    "crowd": _number(0, MOST_CROWD),
}


def parse(text: str) -> Specification:
    """Return the specification that ``WORLD[,key=value...]`` stands for; raises SeamarkError listing what exists."""
    world, *settings = [part.strip() for part in text.split(",")]
    if world not in WORLDS:
        known = ", ".join((*WORLDS, "toy", "small_loop"))
        raise SeamarkError(
            f"there is no synthetic world {world!r}; there are {known}, and what seamark synth list names"
        )
    values: dict[str, str | int] = {}
    for setting in settings:
        key, equals, value = (part.strip() for part in setting.partition("="))
        if not equals or key not in PARSERS:
            raise SeamarkError(f"synthetic world {world} has no setting {setting!r}; there are {', '.join(PARSERS)}")
        if key in values:
            raise SeamarkError(f"setting {key} of synthetic world {world} is given twice")
        values[key] = PARSERS[key](key, value)
    kind = WORLDS[world]
    values = {"frames": kind.frames, "trajectory": kind.trajectory, **values}
    specification = Specification(world, **values)  # type: ignore[arg-type]
    if specification.size not in kind.sizes:
        raise SeamarkError(f"synthetic world {world} has no size={specification.size}, only {', '.join(kind.sizes)}")
    if specification.movers and specification.crowd:
        raise SeamarkError("movers and crowd exclude each other: a crowd has as many people as its share takes")
    if specification.trajectory == LAP and kind.trajectory != LAP:
        raise SeamarkError(f"trajectory=lap belongs to the world loop; in {world} it is called {kind.trajectory}")
    return specification


def content_hash(specification: Specification) -> str:
    """Return 16 hex digits that change with the specification, the code that renders, and the libraries' versions."""
    try:
        simulator = metadata.version("sapien")
    except metadata.PackageNotFoundError:
        simulator = "none"
    digest = hashlib.sha256(json.dumps(asdict(specification), sort_keys=True).encode())
    digest.update(f"sapien {simulator} numpy {np.__version__} cv2 {cv2.__version__}".encode())
    here = Path(__file__).parent
    for file in (*sorted(here.glob("*.py")), *sorted(here.glob("shaders/*"))):
        if file.stem not in CHANGE_NO_PICTURE:
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]
