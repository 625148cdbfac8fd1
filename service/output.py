"""The folder that a run writes into: nothing appears in it before everything is complete."""

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from seamark import SeamarkError

STAGING_PREFIX = ".seamark-partial-"


class OutputError(SeamarkError):
    """The folder for results cannot be used."""


@dataclass(frozen=True)
class Output:
    """Results on their way into ``folder``: files are made in ``staging``, which lies in it, and moved by ``commit()``.

    Used as a context manager it takes away, without a commit, all it has made, the folder itself included.
    """

    folder: Path
    staging: Path
    created: bool

    def commit(self) -> None:
        """Move every staged file into the folder, replacing those of an earlier run; raises OutputError."""
        try:
            staged = [(path, self.folder / path.name) for path in sorted(self.staging.iterdir())]
            for _, target in staged:
                if target.is_dir():
                    raise OutputError(f"{target} is a folder, so the result of that name cannot be written")
            for path, target in staged:
                path.replace(target)
            self.staging.rmdir()
        except OSError as error:
            raise OutputError(f"results cannot be written to {self.folder}: {error.strerror}") from error

    def discard(self) -> None:
        """Remove what was staged, and the folder when this run made it and nothing else lies in it."""
        shutil.rmtree(self.staging, ignore_errors=True)
        if self.created and self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()

    def __enter__(self) -> "Output":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.discard()


def prepare_output(folder: Path) -> Output:
    """Make the folder and a staging folder in it; raises OutputError when it cannot be written to."""
    created = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=STAGING_PREFIX, dir=folder))
    except FileExistsError as error:
        raise OutputError(f"{folder} is a file; --out needs a folder") from error
    except OSError as error:
        raise OutputError(f"{folder} cannot be written to: {error.strerror}") from error
    return Output(folder, staging, created)
