"""The toy world by name, ``toy[,key=value...]``, so that it can stand wherever a rendered world can."""

from dataclasses import dataclass
from typing import Literal

from seamark import SeamarkError
from seamark.datasets_synth import motion_sensors, scenarios, specification, toy, trajectories
from seamark.datasets_synth.sequence import SynthSequence
from seamark.frontend.types import Mode

NAME = "toy"
OWN: tuple[toy.Trajectory, ...] = ("loop", "line", "turn")
# Without those that leave the route: a pillar stands in the middle.
TRAJECTORIES = (*OWN, *(name for name, kind in trajectories.KINDS.items() if name != "loop" and not kind.leaves_route))
SETTINGS = ("frames", "seed", "sensors", "sensor", "trajectory")


@dataclass(frozen=True)
class ToySpecification:
    """One sequence in the toy world, complete; ``sensor`` is the quality of wheels, inertial unit and receiver."""

    frames: int = 120
    seed: int = 0
    sensors: Literal["rgbd", "stereo", "mono"] = "rgbd"
    sensor: str = "mild"
    trajectory: str = "loop"

    def open(self) -> SynthSequence:
        """Return the sequence."""
        mode = Mode(self.sensors)
        if self.trajectory in OWN:
            return toy.toy_sequence(self.trajectory, self.frames, self.seed, mode, specification.FPS)
        poses = trajectories.make_trajectory(self.trajectory, toy.route(), self.frames, specification.FPS, self.seed)
        sequence = toy.toy_sequence("loop", self.frames, self.seed, mode, specification.FPS, poses=poses)
        return SynthSequence(
            f"toy-{self.trajectory}",
            sequence.rig,
            mode,
            self.frames,
            sequence.ground_truth,
            sequence.make_frames,
        )


def is_toy(text: str) -> bool:
    """Tell whether ``NAME[,key=value...]`` names the toy world."""
    return text.split(",")[0].strip() == NAME


def parse(text: str) -> ToySpecification:
    """Return what ``toy[,key=value...]`` stands for; raises SeamarkError that lists what exists."""
    _, settings = scenarios.split(text)
    values: dict[str, str | int] = {}
    for key, value in settings.items():
        if key not in SETTINGS:
            raise SeamarkError(f"the toy world has no setting '{key}={value}'; there are {', '.join(SETTINGS)}")
        if key == "trajectory" and value not in TRAJECTORIES:
            raise SeamarkError(f"the toy world has no trajectory {value!r}; there are {', '.join(TRAJECTORIES)}")
        if key == "sensor" and value not in motion_sensors.MODELS:
            raise SeamarkError(f"there is no sensor={value}; there are {', '.join(motion_sensors.MODELS)}")
        plain = key in ("trajectory", "sensor")
        values[key] = value if plain else specification.PARSERS[key](key, value)
    return ToySpecification(**values)  # type: ignore[arg-type]
