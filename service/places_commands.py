"""The commands `seamark places ...`: recognition between two sets of images, and how well it works on one's own."""

import os
from pathlib import Path
from typing import Annotated

import typer

from seamark.service.terminal import Bar, errors, print_json, print_table

places_app = typer.Typer(no_args_is_help=True, help="Place recognition on folders of images.")

VocabOption = Annotated[Path | None, typer.Option("--vocab", help="Vocabulary file; default: the one that ships.")]
SequenceOption = Annotated[
    bool, typer.Option("--sequence", help="Both sets are in the order in which they were taken: use it.")
]
TogetherOption = Annotated[
    bool,
    typer.Option("--together", help="Leave out what all images of a folder have in common; --sequence does so too."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")]
OverrideOption = Annotated[list[str] | None, typer.Option("-o", metavar="KEY=VALUE", help="Set section.key=value.")]
WorkersOption = Annotated[int | None, typer.Option("--workers", min=1, help="Threads; default: one per processor.")]


def _warn(sentence: str) -> None:
    errors.print("warning:", sentence, markup=False, soft_wrap=True)


@places_app.command("match")
def match_command(
    database: Annotated[Path, typer.Option("--database", help="Folder with the images of known places.")],
    queries: Annotated[Path, typer.Option("--queries", help="Folder with the images to be recognised.")],
    out: Annotated[Path, typer.Option("--out", help="The table to write (CSV).")],
    top: Annotated[int, typer.Option("--top", min=1, help="Rows per query.")] = 20,
    sequence: SequenceOption = False,
    together: TogetherOption = False,
    vocab: VocabOption = None,
    workers: WorkersOption = None,
    override: OverrideOption = None,
    as_json: JsonOption = False,
) -> None:
    """Rank the images of a database for each query image, and say which matches can be trusted."""
    from seamark.service import places_match
    from seamark.service.config import load_config
    from seamark.service.places_images import available_workers

    config = load_config(None, os.environ, override or [])
    options = places_match.MatchOptions(database, queries, out, top, sequence, vocab, together)
    with Bar("describing") as bar:
        summary = places_match.match_folders(options, config, workers or available_workers(), _warn, bar.count)
    if as_json:
        print_json(summary.as_json())
    else:
        print_table(places_match.summary_table(summary, out))


@places_app.command("eval")
def eval_command(
    source: Annotated[str, typer.Argument(help="Folder, video or synth:NAME: the known places.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the results.")],
    against: Annotated[str | None, typer.Option("--against", help="A second traversal that asks.")] = None,
    sequence: SequenceOption = False,
    together: TogetherOption = False,
    distance: Annotated[float, typer.Option("--distance", min=0, help="One place: true poses nearer, in m.")] = 3.0,
    angle: Annotated[float, typer.Option("--angle", min=0, help="One place: directions nearer, in degrees.")] = 45.0,
    tolerance: Annotated[int, typer.Option("--tolerance", min=0, help="One place, without poses: images apart.")] = 3,
    precision: Annotated[float, typer.Option("--precision", min=0, max=1, help="To find a threshold for.")] = 0.95,
    vocab: VocabOption = None,
    workers: WorkersOption = None,
    override: OverrideOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure place recognition on a sequence with itself or with a second traversal, and find a threshold."""
    from seamark.service import places_eval
    from seamark.service.config import load_config
    from seamark.service.places_images import available_workers
    from seamark.service.sources.open import open_sources

    config = load_config(None, os.environ, override or [])
    options = places_eval.EvalOptions(out, sequence, vocab, distance, angle, tolerance, precision, together)
    first = open_sources([source], mode=None if against is None else "places")  # in its own past odometry is asked
    second = None if against is None else open_sources([against], mode="places")
    with Bar("describing") as bar:
        count = workers or available_workers()
        report = places_eval.evaluate_places(first, second, options, config, count, _warn, bar.count)
    if as_json:
        print_json(report)
    else:
        print_table(places_eval.report_table(report))
