"""What the command line writes: tables and JSON on standard output, progress and errors on standard error."""

import json
import sys
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

TABLE_WIDTH = 140
errors = Console(stderr=True, highlight=False)


def print_table(table: Table) -> None:
    """Print a table on standard output."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=TABLE_WIDTH)  # a pipe has no width that a column should bow to
    console.print(table)


def print_json(value: object) -> None:
    """Print plain values on standard output."""
    sys.stdout.write(json.dumps(value, indent=2, allow_nan=False) + "\n")


class Bar:
    """A progress bar over frames, on standard error and only on a terminal."""

    def __init__(self, title: str) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[state]}"),
            console=errors,
            disable=not errors.is_terminal,
        )
        self._task = self._progress.add_task(title, total=None, state="")

    def __enter__(self) -> "Bar":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def __call__(self, done: int, total: int | None, odometry: Any) -> None:
        """Show how many frames are done and what became of the last one."""
        self._progress.update(self._task, completed=done, total=total, state=str(odometry.outcome))

    def count(self, done: int, total: int) -> None:
        """Show how many frames are done."""
        self._progress.update(self._task, completed=done, total=total)
