"""The command line. Heavy modules are imported where they are used, so that --help is instant."""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from streamtrack.errors import StreamtrackError, UsageError

if TYPE_CHECKING:
    from rich.console import Console

    from streamtrack.settings import Settings

app = typer.Typer(
    name="streamtrack",
    help="Track objects in video by local features and homographies; see why in Rerun.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

_PIPED_WIDTH = 200
_DETECTORS = "harris, fast, agast, gftt, brisk, orb, sift, akaze"
_DESCRIPTORS = "freak, brisk, orb, teblid, sift, akaze"

bench_app = typer.Typer(
    help="Measure accuracy and cost on sequences with known truth, against peers.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
app.add_typer(bench_app, name="bench")


def main() -> None:
    """Run the program."""
    # Rerun's own log lines: what matters of them is said in ours, in one line.
    os.environ.setdefault("RUST_LOG", "off")
    # Its allocator shall hand memory back at once: runs last for weeks.
    os.environ.setdefault("MIMALLOC_PURGE_DELAY", "0")
    exit_on_error(lambda: app(standalone_mode=False))


def exit_on_error(run: Callable[[], Any]) -> None:
    """Call ``run``; exit with 2 for wrong usage and 1 for any failure, each said in one line."""
    from typer.exceptions import Abort, TyperException

    try:
        result = run()
        if isinstance(result, int):
            sys.exit(result)
    except TyperException as error:
        if not sys.argv[1:]:
            sys.stderr.write(f"{error.format_message()}\n")  # the help
            sys.exit(error.exit_code)
        _fail(f"{error.format_message().rstrip('.')}; see streamtrack --help", error.exit_code)
    except UsageError as error:
        _fail(error, 2)
    except StreamtrackError as error:
        _fail(error, 1)
    except (Abort, KeyboardInterrupt):
        _fail("interrupted", 1)
    except BrokenPipeError:
        # Nobody reads our output any more; keep Python from complaining while it shuts down.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _fail(message: object, code: int) -> None:
    sys.stderr.write(f"streamtrack: error: {message}\n")
    sys.exit(code)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"streamtrack {version('streamtrack')}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Track objects in video by local features and homographies; see why in Rerun."""


@app.command()
def track(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="Video file, folder or glob of pictures, or synthetic://SCENE?seed=1&frames=300.",
        ),
    ],
    target: Annotated[
        list[str],
        typer.Option(
            help="[NAME=]x,y,w,h or [NAME=]x1,y1,...,x4,y4 in pixels of the first frame, or "
            "[NAME=]PICTURE[@region of it] to search for. May repeat.",
        ),
    ],
    method: Annotated[
        str | None,
        typer.Option(help="hybrid (predict, warp back, flow) or detect (every frame by itself)."),
    ] = None,
    camera: Annotated[str | None, typer.Option(help="fixed or moving.")] = None,
    detector: Annotated[str | None, typer.Option(help=f"{_DETECTORS}.")] = None,
    threshold: Annotated[float | None, typer.Option(help="The detector's own threshold.")] = None,
    descriptor: Annotated[str | None, typer.Option(help=f"{_DESCRIPTORS}.")] = None,
    model: Annotated[
        str | None,
        typer.Option(help="auto, homography, affine, similarity or translation."),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(help="Recording; default recordings/<source>-<start time>.rrd."),
    ] = None,
    no_record: Annotated[bool, typer.Option("--no-record", help="Make no recording.")] = False,
    record_video: Annotated[
        str | None,
        typer.Option(help="Picture in the recording: auto (copy packets), jpeg, av1 or none."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(help="Table of tracks: .csv, .jsonl, .parquet, or .txt (MOT)."),
    ] = None,
    poses: Annotated[Path | None, typer.Option(help="CSV of the camera's poses.")] = None,
    video: Annotated[
        Path | None, typer.Option(help="Annotated copy: .mp4, .mkv, .webm, .avi.")
    ] = None,
    summary: Annotated[Path | None, typer.Option(help="Summary as JSON.")] = None,
    settings: Annotated[Path | None, typer.Option(help="Settings as TOML; flags win.")] = None,
    start: Annotated[int, typer.Option(min=0, help="First frame, counted from 0.")] = 0,
    step: Annotated[int, typer.Option(min=1, help="Use every n-th frame.")] = 1,
    frames: Annotated[int | None, typer.Option(min=1, help="Use at most n frames.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False,
) -> None:
    """Follow targets through a video and write a recording, tables and a summary."""
    chosen = _settings(
        settings,
        {
            "features": {"detector": detector, "threshold": threshold, "descriptor": descriptor},
            "registration": {"model": model},
            "tracker": {"method": method},
            "camera": camera,
            "recording": {"video": record_video},
        },
    )
    from streamtrack.job import Outputs, TrackJob, run_track
    from streamtrack.targets import parse_targets

    if no_record and record is not None:
        raise UsageError("--record and --no-record contradict each other: give one of them")
    if not no_record and record is None:
        record = _default_recording(source)
    job = TrackJob(
        source,
        parse_targets(target),
        chosen,
        Outputs(None if no_record else record, output, poses, video, summary),
        start,
        step,
        frames,
    )
    console, errors = _consoles()
    with (
        _warnings_shown(errors, quiet),
        _progress(errors, quiet) as progress,
        _StopOnSignal() as stop,
    ):
        outcome = run_track(job, progress, stop)
    if not quiet:
        _print_summary(console, outcome.summary.rows(), job.outputs.record)
    if outcome.error is not None:
        raise outcome.error


@app.command()
def synth(
    uri: Annotated[str, typer.Argument(metavar="URI", help="synthetic://SCENE?seed=1&frames=300")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Video file, or a folder for PNG pictures.")
    ],
    truth: Annotated[Path | None, typer.Option(help="CSV of the exact truth.")] = None,
) -> None:
    """Write a synthetic sequence and its exact truth to files."""
    from streamtrack.synth import write_synthetic

    with _StopOnSignal() as stop:
        written = write_synthetic(uri, output, truth, stop)
    if stop():
        raise StreamtrackError(f"interrupted after {written} frames: these are written")


@app.command()
def view(
    recording: Annotated[Path, typer.Argument(metavar="FILE.rrd", help="The recording to open.")],
    web: Annotated[bool, typer.Option("--web", help="In the browser, on 127.0.0.1.")] = False,
    port: Annotated[int | None, typer.Option(help="Port of the web page.")] = None,
) -> None:
    """Open a recording in the Rerun viewer."""
    from streamtrack.viewer import view as open_viewer

    raise typer.Exit(open_viewer(recording, web=web, port=port))


@bench_app.command("track")
def bench_track(
    quick: Annotated[
        bool, typer.Option("--quick", help="A reduced set, in about a minute.")
    ] = False,
    scenes: Annotated[
        str | None,
        typer.Option(help="Scenes of synthetic://, as blur,static; none for --pot alone."),
    ] = None,
    seeds: Annotated[str | None, typer.Option(help="Seeds of each scene; default 1,2,3.")] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            help="streamtrack, harris-freak, sift, brisk, plane-tracker, lk-chain, prewarp-lk, "
            "prewarp-dis, csrt, kcf; default all."
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=3, help="Frames of each sequence; default 150.")
    ] = None,
    pot: Annotated[
        Path | None, typer.Option(help="Folder of POT sequences, to be run as well.")
    ] = None,
    json_path: Annotated[
        Path | None, typer.Option("--json", help="Everything that was measured, as JSON.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Accuracy over cost, as PNG.")] = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="The factors of every method.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Tell no progress.")] = False,
) -> None:
    """Track sequences with known truth by streamtrack and its peers, on the very same frames."""
    from streamtrack.bench.command import Request, run_request, tell_on

    console, errors = _consoles()
    request = Request(quick, scenes, seeds, methods, frames, pot, json_path, plot, verbose)
    with _warnings_shown(errors, quiet), _StopOnSignal() as stop:
        run_request(request, console, (lambda _line: None) if quiet else tell_on(errors), stop)


def _settings(path: Path | None, flags: dict[str, Any]) -> Settings:
    from streamtrack.settings import build_settings, read_settings_file

    values = read_settings_file(path) if path is not None else {}
    for section, value in flags.items():
        if isinstance(value, dict):
            given = {name: item for name, item in value.items() if item is not None}
            in_file = values.get(section, {})
            if given and isinstance(in_file, dict):
                values[section] = {**in_file, **given}
        elif value is not None:
            values[section] = value
    return build_settings(values)


def _default_recording(source: str) -> Path:
    from streamtrack.types import SourceInfo

    stem = Path(SourceInfo(source, (0, 0), None, None).name).stem or "source"
    safe = "".join(c if c.isalnum() or c in "-_." else "-" for c in stem)
    first = Path("recordings") / f"{safe}-{time.strftime('%Y%m%d-%H%M%S')}.rrd"
    path, number = first, 1
    while path.exists():
        number += 1
        path = first.with_stem(f"{first.stem}-{number}")
    return path


def _consoles() -> tuple[Console, Console]:
    from rich.console import Console

    # Piped, a table must not be wrapped, so that it can be searched.
    output = Console() if sys.stdout.isatty() else Console(width=_PIPED_WIDTH)
    return output, Console(stderr=True)


@contextmanager
def _warnings_shown(errors: Console, quiet: bool) -> Iterator[None]:
    """Log records of the run go to stderr, above the progress bar if there is one."""
    from rich.logging import RichHandler

    handler: logging.Handler
    if errors.is_terminal:
        handler = RichHandler(console=errors, show_time=False, show_path=False, markup=False)
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("streamtrack: warning: %(message)s"))
    handler.setLevel(logging.ERROR if quiet else logging.WARNING)
    logger = logging.getLogger("streamtrack")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def _progress(errors: Console, quiet: bool) -> Any:
    from streamtrack.progress import NoProgress, ProgressBar, ProgressLines

    if quiet:
        return NoProgress()
    return ProgressBar(errors) if errors.is_terminal else ProgressLines(errors)


def _print_summary(console: Console, rows: list[tuple[str, str]], record: Path | None) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for label, value in rows:
        table.add_row(Text(label, style="bold"), Text(value))
    with console.capture() as capture:
        console.print(table)
    for line in capture.get().splitlines():
        console.file.write(line.rstrip() + "\n")
    if record is not None:
        console.print(Text(f"\nOpen the recording: streamtrack view {record}"), soft_wrap=True)


class _StopOnSignal:
    """True once SIGINT or SIGTERM came: the run ends after the frame it is at.

    A second signal interrupts at once, for a run that hangs.
    """

    def __init__(self) -> None:
        self._came = False
        self._before: dict[int, Any] = {}

    def __call__(self) -> bool:
        return self._came

    def __enter__(self) -> _StopOnSignal:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._stop)
        return self

    def __exit__(self, *exc: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self._came:
            raise KeyboardInterrupt
        self._came = True


if __name__ == "__main__":
    main()
