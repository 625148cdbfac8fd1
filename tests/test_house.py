"""The house itself: documents that tell the truth, locks that name no host, a wheel that is complete."""

import importlib.metadata
import re
import shlex
import subprocess
import sys
import tomllib
import venv
from pathlib import Path

import cv2
import pytest
from typer.main import get_command

import seamark
from seamark.service.cli import app
from seamark.service.topics import markdown_table

ROOT = Path(__file__).parents[1]
ROOMS = ("frontend", "vocab", "backend", "service", "datasets_synth")
LOCKS = ("requirements.lock", "docker/requirements.lock")


def documented_commands() -> list[list[str]]:
    """Return every `seamark ...` line of the shell blocks of README and docs."""
    commands = []
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for block in re.findall(r"```sh\n(.*?)```", path.read_text(), re.S):
            for line in block.splitlines():
                words = shlex.split(line.split(" &")[0], comments=True)
                while words and "=" in words[0]:
                    words = words[1:]
                if words and words[0] == "seamark":
                    commands.append(words[1:])
    return commands


def test_documented_commands_exist_with_their_options() -> None:
    root = get_command(app)
    commands = documented_commands()
    assert len(commands) >= 10
    for words in commands:
        command, rest = root, list(words)
        while hasattr(command, "commands"):
            assert rest[0] in command.commands, words
            command = command.commands[rest.pop(0)]
        options = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
        used = {word for word in rest if word.startswith("-")}
        assert used <= options, (words, used - options)


def test_readme_begins_with_sentence_picture_and_the_two_commands() -> None:
    first_screen = "\n".join((ROOT / "README.md").read_text().splitlines()[:25])
    picture = re.search(r"!\[.+\]\((.+\.png)\)", first_screen)
    assert picture is not None
    image = cv2.imread(str(ROOT / picture[1]))
    assert image is not None and min(image.shape[:2]) > 400
    assert "make demo" in first_screen and "make test" in first_screen
    assert "What it is not" in first_screen


def test_help_of_every_command_is_printed() -> None:
    for words in ([], ["run"], ["serve"], ["query"], ["vocab", "train"], ["config", "show"]):
        done = subprocess.run(
            [sys.executable, "-c", "from seamark.service.cli import main; main()", *words, "--help"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert "Usage" in done.stdout


def test_api_document_has_the_table_of_topics() -> None:
    assert markdown_table() in (ROOT / "docs" / "api.md").read_text()


@pytest.mark.parametrize("lock", LOCKS)
def test_lock_pins_every_dependency_and_names_no_host(lock: str) -> None:
    text = (ROOT / lock).read_text()
    assert "://" not in text and "index" not in text
    pinned = {line.split("==")[0].lower() for line in text.splitlines() if "==" in line}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = {re.split(r"[<>=\[ ]", name)[0].lower() for name in project["dependencies"]}
    assert wanted <= pinned


def test_only_the_contrib_wheel_of_opencv_is_installed() -> None:
    assert hasattr(cv2, "xfeatures2d")
    installed = {distribution.name.lower() for distribution in importlib.metadata.distributions()}
    assert "opencv-python" not in installed


def test_sdist_and_wheel_hold_every_room(tmp_path: Path) -> None:
    """Expected: sdist, then the wheel made from it, installed not editable, imports every room from site-packages."""
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    (wheel,) = tmp_path.glob("*.whl")
    venv.create(tmp_path / "clean", with_pip=False, symlinks=True)
    site = next((tmp_path / "clean" / "lib").glob("python3*/site-packages"))
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(site), str(wheel)]
    subprocess.run(install, check=True, capture_output=True)
    # The dependencies are those of the running environment; seamark itself must come from the wheel.
    own = next(p for p in sys.path if p.endswith("site-packages"))
    code = "import sys; sys.path.append(sys.argv[1])\n" + "\n".join(f"import seamark.{room}" for room in ROOMS)
    code += "\nfrom seamark.vocab.vocabulary import Vocabulary; assert Vocabulary.default().n_words >= 1000"
    code += "\nfrom seamark.vocab.kernels import native; assert 'baseline' in native.levels()"
    code += f"\nassert native.__file__.startswith({str(site)!r})"
    code += "\nfrom seamark.datasets_synth.fallback import small_loop_path; assert small_loop_path().is_dir()"
    code += "\nprint(seamark.__file__)"
    python = tmp_path / "clean" / "bin" / "python"
    done = subprocess.run([python, "-I", "-c", code, own], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert str(site) in done.stdout


def test_version_is_the_projects() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert seamark.__version__ == project["version"]
