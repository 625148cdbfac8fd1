"""`seamark places match`: every image of one folder against the images of another."""

import csv
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from seamark.service.config import SeamarkConfig
from seamark.service.output import OutputError
from seamark.service.places_images import DescribedImage, Progress, describe_files
from seamark.service.places_search import Answer, search
from seamark.service.sources.base import SourceError
from seamark.service.sources.images import SUFFIXES, list_images
from seamark.vocab.vocabulary import Vocabulary

COLUMNS = ("query", "rank", "match", "score", "votes", "jeffrey", "inliers", "accepted")
NAMED_IN_WARNING = 3


@dataclass(frozen=True)
class MatchOptions:
    """What was asked for; ``vocabulary`` None means the one that ships, ``in_order`` that order is evidence.

    With ``together`` or ``in_order`` images are compared without what all of a folder have in common; with neither the
    answer to a query depends on no other query.
    """

    database: Path
    queries: Path
    out: Path
    top: int = 20
    in_order: bool = False
    vocabulary: Path | None = None
    together: bool = False


@dataclass(frozen=True)
class MatchSummary:
    """What the command says at its end; ``verdicts`` counts the queries by what became of them."""

    database_images: int
    query_images: int
    rows: int
    verdicts: dict[str, int]

    def as_json(self) -> dict[str, object]:
        """Return plain values."""
        return {
            "database_images": self.database_images,
            "query_images": self.query_images,
            "rows": self.rows,
            "verdicts": self.verdicts,
        }


def match_folders(
    options: MatchOptions,
    config: SeamarkConfig,
    workers: int,
    warn: Callable[[str], None],
    progress: Progress | None = None,
) -> MatchSummary:
    """Rank the images of the database for each query image and write the table ``options.out``.

    Images that cannot be read are told to ``warn`` in one sentence per folder; they keep their rows, ranked last or by
    nothing. Raises SourceError for a folder without images, OutputError where the table cannot be written.
    """
    vocabulary = Vocabulary.default() if options.vocabulary is None else Vocabulary.load(options.vocabulary)
    files = [_images(options.database), _images(options.queries)]
    total = sum(len(part) for part in files)
    described: list[list[DescribedImage]] = []
    for folder, part in zip((options.database, options.queries), files, strict=True):
        before = sum(len(images) for images in described)
        count = _shifted(progress, before, total)
        described.append(describe_files(part, config.frontend, workers, count))
        warn_of_unreadable(str(folder), described[-1], warn)
    database, queries = described
    answers = search(
        database,
        queries,
        vocabulary,
        config.vocab,
        top=options.top,
        in_order=options.in_order,
        workers=workers,
        together=options.together or options.in_order,
    )
    rows = matches_table(database, queries, answers)
    write_table(options.out, rows)
    verdicts = Counter(str(answer.verdict) for answer in answers)
    return MatchSummary(len(database), len(queries), len(rows), dict(sorted(verdicts.items())))


def summary_table(summary: MatchSummary, out: Path) -> Table:
    """Return the summary for people."""
    table = Table(show_header=False, box=None)
    table.add_row("database", f"{summary.database_images} images")
    table.add_row("queries", f"{summary.query_images} images")
    for verdict, count in summary.verdicts.items():
        table.add_row(verdict.replace("_", " "), str(count))
    table.add_row("results", f"{out} ({summary.rows} rows)")
    return table


def _images(folder: Path) -> list[Path]:
    files = list_images(folder)
    if not files:
        raise SourceError(f"{folder} holds no images ({', '.join(sorted(SUFFIXES))})")
    return files


def _shifted(progress: Progress | None, before: int, total: int) -> Progress | None:
    if progress is None:
        return None
    return lambda done, _: progress(before + done, total)


def warn_of_unreadable(where: str, images: Sequence[DescribedImage], warn: Callable[[str], None]) -> None:
    """Tell ``warn`` in one sentence how many images cannot be used and why; nothing where all can."""
    broken = [image.problem for image in images if image.problem is not None]
    if broken:
        more = f", and {len(broken) - NAMED_IN_WARNING} more" if len(broken) > NAMED_IN_WARNING else ""
        named = "; ".join(broken[:NAMED_IN_WARNING])
        warn(f"{len(broken)} of {len(images)} images in {where} cannot be used: {named}{more}")


def matches_table(
    database: Sequence[DescribedImage], queries: Sequence[DescribedImage], answers: Sequence[Answer]
) -> list[tuple[str, ...]]:
    """Return the rows of matches.csv under COLUMNS."""
    rows = []
    for query, answer in zip(queries, answers, strict=True):
        for rank, match in enumerate(answer.matches, 1):
            values = (f"{value:.6f}" for value in (match.score, match.votes, match.jeffrey))
            accepted = "1" if match.accepted else "0"
            rows.append((query.name, str(rank), database[match.place].name, *values, str(match.inliers), accepted))
    return rows


def write_table(path: Path, rows: Sequence[tuple[str, ...]]) -> None:
    """Write matches.csv, complete or not at all; raises OutputError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}") from error
    partial = Path(name)
    try:
        with os.fdopen(handle, "w", newline="", encoding="utf-8", errors="surrogateescape") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(COLUMNS)
            writer.writerows(rows)
        partial.chmod(0o666 & ~_umask())
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise OutputError(f"{path} cannot be written: {error.strerror}") from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
