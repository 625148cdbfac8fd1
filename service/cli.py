"""The command line: arguments in, one typed call, a table or JSON out."""

import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from seamark import SeamarkError, __version__
from seamark.service.covariance_commands import covariances_command
from seamark.service.graph_commands import graph_app
from seamark.service.loop_commands import loops_command
from seamark.service.map_commands import map_app
from seamark.service.optimise_commands import optimise_command
from seamark.service.places_commands import places_app
from seamark.service.synth_commands import synth_app
from seamark.service.terminal import Bar, errors, print_json, print_table

# Everything else is imported in the command that needs it: --help must not wait for GTSAM, faiss and rerun.

EXIT_ERROR = 1
EXIT_INTERRUPTED = 130
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

app = typer.Typer(
    name="seamark",
    help="Place recognition and visual SLAM as a service: have I been here, and where am I?",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
vocab_app = typer.Typer(no_args_is_help=True, help="Visual vocabularies.")
config_app = typer.Typer(no_args_is_help=True, help="The configuration.")
app.add_typer(vocab_app, name="vocab")
app.add_typer(config_app, name="config")
app.add_typer(synth_app, name="synth")
app.add_typer(graph_app, name="graph")
app.add_typer(places_app, name="places")
app.add_typer(map_app, name="map")
map_app.command("loops")(loops_command)
map_app.command("optimise")(optimise_command)
map_app.command("covariances")(covariances_command)

Sources = Annotated[list[str], typer.Argument(help="Folders, videos or synth:NAME, taken one after another.")]
OutFolder = Annotated[Path, typer.Option("--out", help="Folder for the results.")]
ModeOption = Annotated[str | None, typer.Option("--mode", help="mono, stereo, rgbd or places; default: the richest.")]
CalibOption = Annotated[Path | None, typer.Option("--calib", help="Calibration file; overrides the data set's own.")]
VocabOption = Annotated[Path | None, typer.Option("--vocab", help="Vocabulary file; default: the one that ships.")]
FpsOption = Annotated[float | None, typer.Option("--fps", help="Frame rate of image folders (default 1) and videos.")]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Seed of every random choice (default 0).")]
NoLoopsOption = Annotated[bool, typer.Option("--no-loops", help="Odometry only: no loop is ever closed.")]
RealtimeOption = Annotated[bool, typer.Option("--realtime", help="Send frames at the pace of their stamps.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
OverrideOption = Annotated[list[str] | None, typer.Option("-o", metavar="KEY=VALUE", help="Set section.key=value.")]
ConfigOption = Annotated[Path | None, typer.Option("--config", help="YAML file with settings.")]
ConnectOption = Annotated[str, typer.Option("--connect", help="Zenoh endpoint of the service.")]
NamespaceOption = Annotated[str, typer.Option("--namespace", help="Namespace of the service's keys.")]


def _config(path: Path | None, overrides: list[str] | None, seed: int | None) -> Any:
    from seamark.service.config import load_config

    extra = [] if seed is None else [f"seed={seed}"]
    return load_config(path, os.environ, [*(overrides or []), *extra])


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        sys.stdout.write(f"seamark {__version__}\n")
        raise typer.Exit


@app.command("run")
def run_command(
    sources: Sources,
    out: OutFolder,
    mode: ModeOption = None,
    calib: CalibOption = None,
    vocab: VocabOption = None,
    seed: SeedOption = None,
    fps: FpsOption = None,
    no_loops: NoLoopsOption = False,
    in_process: Annotated[bool, typer.Option("--in-process", help="One process, same bits at every run.")] = False,
    realtime: RealtimeOption = False,
    map_file: Annotated[
        Path | None, typer.Option("--map", help="A map to go on with; it is copied and stays as it is.")
    ] = None,
    localise_only: Annotated[
        bool, typer.Option("--localise-only", help="Find the frames in the map of --map, and learn nothing.")
    ] = False,
    as_json: JsonOption = False,
    override: OverrideOption = None,
    config: ConfigOption = None,
) -> None:
    """Replay data end to end: trajectory, loops, map, recording, picture and report."""
    from seamark.service.config import for_mode
    from seamark.service.report import build_report, report_table
    from seamark.service.run import RunOptions, run
    from seamark.service.sources.open import open_sources

    if localise_only and map_file is None:
        raise typer.BadParameter("it needs --map", param_hint="--localise-only")
    settings = _config(config, override, seed)
    source = open_sources(sources, mode=mode, calib=calib, fps=fps)
    options = RunOptions(out, tuple(sources), vocab, not no_loops, in_process, realtime, map_file, localise_only)
    with Bar(source.name) as bar:
        record = run(source, options, settings, bar)
    report = build_report(record, for_mode(settings, record.mode))
    if as_json:
        print_json(report)
    else:
        print_table(report_table(report))
        sys.stdout.write(f"results: {out}\n")


@app.command("demo")
def demo_command(out: OutFolder = Path("demo"), as_json: JsonOption = False, override: OverrideOption = None) -> None:
    """Render a loop of more than 60 m, close it, and show the map."""
    from seamark.service.demo import demonstrate
    from seamark.service.report import build_report, report_table

    settings = _config(None, override, None)
    with Bar("demo") as bar:
        shown = demonstrate(out, settings, bar)
    report = build_report(shown.record, settings)
    if as_json:
        print_json(report)
        return
    if shown.notice:
        sys.stdout.write(shown.notice + "\n")
    print_table(report_table(report))
    for what, name in (("picture", shown.picture.name), ("recording", "run.rrd"), ("report", "report.json")):
        sys.stdout.write(f"{what + ':':<11}{out / name}\n")
    sys.stdout.write(f"look at it: {Path(sys.executable).parent / 'rerun'} {out / 'run.rrd'}\n")


@app.command("serve")
def serve_command(
    calib: CalibOption = None,
    mode: ModeOption = None,
    map_file: Annotated[Path, typer.Option("--map", help="The map; made if missing.")] = Path("map.seamark"),
    vocab: VocabOption = None,
    listen: Annotated[str, typer.Option("--listen", help="Where the service's own router listens.")] = DEFAULT_ENDPOINT,
    connect: Annotated[str | None, typer.Option("--connect", help="Use this router instead of an own one.")] = None,
    namespace: NamespaceOption = "default",
    no_loops: NoLoopsOption = False,
    localise_only: Annotated[
        bool, typer.Option("--localise-only", help="Answer from the map and never write to it.")
    ] = False,
    seed: SeedOption = None,
    override: OverrideOption = None,
    config: ConfigOption = None,
) -> None:
    """Keep the three nodes alive: frames in, places out, until SIGTERM or Ctrl-C."""
    from seamark.service.process_end import leave
    from seamark.service.serve import ServeOptions, serve

    options = ServeOptions(calib, mode, map_file, vocab, listen, connect, namespace, not no_loops, localise_only)

    def ready(endpoint: str, served_mode: str) -> None:
        sys.stdout.write(f"seamark serves mode {served_mode} at {endpoint}, namespace {namespace}, map {map_file}\n")
        sys.stdout.flush()

    serve(options, _config(config, override, seed), ready)
    leave(0)


@app.command("feed")
def feed_command(
    sources: Sources,
    connect: ConnectOption = DEFAULT_ENDPOINT,
    namespace: NamespaceOption = "default",
    mode: ModeOption = None,
    calib: CalibOption = None,
    fps: FpsOption = None,
    realtime: RealtimeOption = False,
    as_json: JsonOption = False,
) -> None:
    """Send the frames of a source to a running service."""
    from seamark.service.feed import feed
    from seamark.service.sources.open import open_sources

    source = open_sources(sources, mode=mode, calib=calib, fps=fps)
    window = _config(None, None, None).service.frame_window
    with Bar(source.name) as bar:
        outcomes = feed(source, endpoint=connect, namespace=namespace, window=window, realtime=realtime, progress=bar)
    if as_json:
        print_json(outcomes)
    else:
        sys.stdout.write(", ".join(f"{count} {outcome}" for outcome, count in sorted(outcomes.items())) + "\n")


@app.command("query")
def query_command(
    image: Annotated[Path, typer.Argument(help="A JPEG or PNG file.")],
    connect: ConnectOption = DEFAULT_ENDPOINT,
    namespace: NamespaceOption = "default",
    top: Annotated[int, typer.Option("--top", min=1, max=1000, help="At most this many places.")] = 5,
    timeout: Annotated[float, typer.Option("--timeout", min=0.1, help="Seconds to wait for the answer.")] = 10.0,
    as_json: JsonOption = False,
) -> None:
    """Ask a running service: have I been here, and where am I?"""
    from seamark.service import query

    reply = query.ask(image, endpoint=connect, namespace=namespace, top_k=top, timeout_s=timeout)
    if as_json:
        print_json(query.as_json(reply))
    elif reply.error_code is None:
        print_table(query.table(reply))
    if reply.error_code is not None:
        raise query.QueryError(f"{reply.error_code}: {reply.error_message}")


@app.command("eval")
def eval_command(
    trajectory: Annotated[Path, typer.Argument(help="Estimated poses: TUM, KITTI or EuRoC format.")],
    ground_truth: Annotated[Path, typer.Argument(help="True poses: TUM, KITTI or EuRoC format.")],
    align: Annotated[str, typer.Option("--align", help="se3, sim3 or none.")] = "se3",
    as_json: JsonOption = False,
) -> None:
    """Compare a trajectory with the truth: absolute and relative errors."""
    from seamark.service import evaluation_report

    result = evaluation_report.evaluate_files(trajectory, ground_truth, align)
    if as_json:
        print_json(result)
    else:
        print_table(evaluation_report.table(result))


@vocab_app.command("train")
def vocab_train_command(
    sources: Sources,
    words: Annotated[int, typer.Option("--words", min=2, help="Number of visual words.")],
    out: Annotated[Path, typer.Option("--out", help="The vocabulary file to write.")],
    fps: FpsOption = None,
    seed: SeedOption = None,
    override: OverrideOption = None,
    as_json: JsonOption = False,
) -> None:
    """Train a vocabulary on the images of sources."""
    from seamark.service.sources.open import open_sources
    from seamark.service.training import train_vocabulary

    config = _config(None, override, seed)
    source = open_sources(sources, mode="places", fps=fps)
    with errors.status("training") as status:
        vocabulary = train_vocabulary(
            source,
            words,
            out,
            seed=config.seed,
            config=config.frontend,
            progress=lambda stage, count: status.update(f"{stage} ({count})"),
        )
    if as_json:
        print_json({"file": str(out), "words": vocabulary.n_words, "hash": vocabulary.hash})
    else:
        sys.stdout.write(f"{out}: {vocabulary.n_words} words, hash {vocabulary.hash[:16]}\n")


@config_app.command("show")
def config_show_command(
    override: OverrideOption = None, config: ConfigOption = None, as_json: JsonOption = False
) -> None:
    """Print the whole configuration as it would be used."""
    from seamark.service.config import dump_yaml

    resolved = _config(config, override, None)
    if as_json:
        print_json(resolved.model_dump(mode="json"))
    else:
        sys.stdout.write(dump_yaml(resolved))


def main() -> None:
    """Run the command line; the one place where errors become a sentence and an exit code.

    0 success, 1 an error that has been said in one sentence, 2 wrong usage, 130 interrupted.
    """
    # Whoever ends a run with SIGTERM gets the same tidy end as with Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        app()
    except SeamarkError as error:
        errors.print("error:", str(error), markup=False, soft_wrap=True)
        sys.exit(EXIT_ERROR)
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)
