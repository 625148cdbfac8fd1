"""What `seamark map ...` says of files that are no whole map of this version: one sentence and exit code 1."""

import shutil
import sqlite3
from pathlib import Path

import pytest
from typer.testing import CliRunner

from seamark import SeamarkError
from seamark.backend.map_schema import SCHEMA_VERSION
from seamark.service.cli import app

GOLDEN = Path(__file__).parents[1] / "backend" / "golden"
COMMANDS = {
    "info": (),
    "check": (),
    "loops": (),
    "export": ("--out", "out"),
    "backup": ("--out", "out"),
    "repair": ("--out", "out"),
    "prune": ("--keyframes", "2"),
    "optimise": ("--full",),
}
WRITERS = ("prune", "optimise")  # they bring an old map up to date


def make(kind: str, path: Path) -> None:
    if kind == "empty":
        path.touch()
    elif kind == "foreign":
        path.write_bytes(bytes(range(256)) * 64)
    elif kind == "another database":
        sqlite3.connect(path).execute("CREATE TABLE other (a)").connection.close()
    elif kind == "folder":
        path.mkdir()
    elif kind.startswith("version"):
        shutil.copy(GOLDEN / f"map_v{kind[-1]}.seamark", path)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("missing", "there is no map at"),
        ("empty", "is no map of Seamark"),
        ("foreign", "is no map of Seamark"),
        ("another database", "is no map of Seamark"),
        ("folder", "is a folder"),
        (
            "version 1",
            f"has map version 1; a service that learns brings it to {SCHEMA_VERSION}, and so does seamark map",
        ),
        (
            "version 2",
            f"has map version 2; a service that learns brings it to {SCHEMA_VERSION}, and so does seamark map",
        ),
    ],
)
def test_a_file_that_is_no_map_of_this_version_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, kind: str, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("some.file")
    make(kind, path)
    before = path.read_bytes() if path.is_file() else None
    result = CliRunner().invoke(app, ["map", command, str(path), *COMMANDS[command]])
    old = kind.startswith("version")
    if old and command == "repair":
        assert result.exit_code == 0 and Path("out").is_file()
        return
    if old and command == "prune":
        assert result.exit_code == 0 and "kept, 2 wanted" in result.stdout
        return
    assert isinstance(result.exception, SeamarkError)
    if not (old and command in WRITERS):
        expected = "nothing could be saved" if command == "repair" and kind not in ("missing", "folder") else words
        assert expected in str(result.exception) and "\n" not in str(result.exception)
        assert (path.read_bytes() if path.is_file() else None) == before
    assert {one.name for one in tmp_path.iterdir()} <= {path.name}
