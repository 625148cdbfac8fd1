"""Ready-made sequences that benchmarks call by name, ``synth:NAME``: what each one makes hard."""

from dataclasses import dataclass

from seamark import SeamarkError


@dataclass(frozen=True)
class Scenario:
    """A world with settings (``key=value,...``) under a name; ``purpose`` says in a few words what it tests."""

    number: int
    name: str
    world: str
    settings: str
    purpose: str

    @property
    def text(self) -> str:
        """Return what the name stands for."""
        return f"{self.world},{self.settings}"


def _numbered(*rows: tuple[str, str, str, str]) -> dict[str, Scenario]:
    return {row[0]: Scenario(number, *row) for number, row in enumerate(rows, 1)}


SCENARIOS = _numbered(
    ("toy_loop", "toy", "frames=300,sensors=rgbd", "one loop without a simulator, in half a minute"),
    ("lap", "loop", "frames=600,sensors=rgbd", "one loop to close in easy light"),
    ("lap_cheap", "loop", "frames=600,sensors=rgbd,sensor=cheap", "drift: depth is warped by three per cent"),
    (
        "first_day",
        "loop",
        "trajectory=loop,frames=780,sensors=stereo,camera=real",
        "the map for second_dusk, third_night",
    ),
    (
        "second_dusk",
        "loop",
        "trajectory=second_traversal,frames=780,sensors=stereo,camera=real,condition=dusk,run=1",
        "the way of first_day again at dusk, aside and looking aside",
    ),
    (
        "third_night",
        "loop",
        "trajectory=second_traversal,frames=780,sensors=stereo,camera=real,condition=night,run=2",
        "the way of first_day again at night under lamps",
    ),
    (
        "changing_light",
        "loop",
        "trajectory=loop,frames=780,sensors=rgbd,camera=real,condition=changing",
        "light, exposure and gain change on the way",
    ),
    ("crowd", "loop", "trajectory=loop,frames=780,sensors=rgbd,movers=3", "people move through the picture"),
    (
        "back_again",
        "loop",
        "trajectory=there_and_back,size=small,frames=420,sensors=rgbd",
        "every place again in the opposite direction: little surface is shared",
    ),
    (
        "stop_and_go",
        "loop",
        "trajectory=stop_and_go,size=small,frames=670,sensors=rgbd",
        "standing still must add neither keyframes nor drift",
    ),
    (
        "spin",
        "loop",
        "trajectory=pure_rotation,frames=755,sensors=mono",
        "turns without parallax, which mono must survive",
    ),
    (
        "kidnapped",
        "loop",
        "trajectory=kidnap,frames=800,sensors=rgbd",
        "carried to an unknown place, then to a known one",
    ),
    (
        "hand_held",
        "loop",
        "trajectory=hand_held,frames=725,sensors=mono,camera=barrel",
        "jitter, motion blur and distortion",
    ),
    ("office_rooms", "office", "trajectory=hand_held,frames=740,sensors=rgbd", "rooms that repeat"),
    ("twin_corridors", "twins", "frames=790,sensors=rgbd", "two corridors that look alike are different places"),
    (
        "hall_flight",
        "hall",
        "trajectory=six_dof,frames=700,sensors=stereo,camera=real",
        "few features, all six degrees",
    ),
    ("hall_mower", "hall", "trajectory=lawn_mower,frames=760,sensors=rgbd", "lanes side by side with few features"),
    ("hall_eight", "hall", "trajectory=figure_eight,frames=625,sensors=rgbd", "one place crossed in two directions"),
    ("street_day", "street", "frames=760,sensors=stereo,camera=real", "a large loop at the pace of a car"),
    (
        "street_night",
        "street",
        "trajectory=second_traversal,frames=760,sensors=stereo,camera=real,condition=night,run=1",
        "street_day again by night",
    ),
    ("road", "road", "trajectory=once,frames=800,sensors=stereo,camera=real", "no place twice: every loop is false"),
    (
        "crowd_rgbd",
        "loop",
        "trajectory=loop,frames=780,sensors=rgbd,crowd=40",
        "people hide up to 40 % of the picture: most of what moves must not be believed",
    ),
    (
        "crowd_stereo",
        "loop",
        "trajectory=loop,frames=780,sensors=stereo,camera=real,crowd=40",
        "the same with motion blur and without a depth camera",
    ),
    (
        "onlooker",
        "loop",
        "trajectory=standing,frames=550,sensors=rgbd,crowd=40",
        "the camera stands while people walk: their motion must not become its own",
    ),
)


def split(text: str) -> tuple[str, dict[str, str]]:
    """Return the name and the settings of ``NAME[,key=value...]``; raises SeamarkError for a malformed setting."""
    name, *parts = (part.strip() for part in text.split(","))
    settings: dict[str, str] = {}
    for part in parts:
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or not key:
            raise SeamarkError(f"{name}: {part!r} is not key=value")
        if key in settings:
            raise SeamarkError(f"setting {key} of synthetic world {name} is given twice")
        settings[key] = value
    return name, settings


def join(name: str, settings: dict[str, str]) -> str:
    """Return ``NAME[,key=value...]``."""
    return ",".join([name, *(f"{key}={value}" for key, value in settings.items())])


def expand(text: str) -> str:
    """Return ``text`` with the name of a scenario replaced by what it stands for; settings after it take precedence."""
    if text.split(",")[0].strip() not in SCENARIOS:
        return text
    name, changed = split(text)
    world, settings = split(SCENARIOS[name].text)
    return join(world, {**settings, **changed})
