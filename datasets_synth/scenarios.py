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
    ("lap", "loop", "frames=600,sensors=rgbd", "one loop to close, in easy light"),
    ("lap_cheap", "loop", "frames=600,sensors=rgbd,sensor=cheap", "drift: depth is warped by three per cent"),
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
