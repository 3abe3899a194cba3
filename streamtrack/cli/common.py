"""What the commands share: settings from flags and file, consoles, summary, signals."""

from __future__ import annotations

import gc
import logging
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from streamtrack.settings import Settings

_PIPED_WIDTH = 200

# Options that `track` and `mosaic` share.
DetectorOption: TypeAlias = Annotated[
    str | None, typer.Option(help="harris, fast, agast, gftt, brisk, orb, sift, akaze.")
]
ThresholdOption: TypeAlias = Annotated[
    float | None, typer.Option(help="The detector's own threshold.")
]
DescriptorOption: TypeAlias = Annotated[
    str | None, typer.Option(help="freak, brisk, orb, teblid, sift, akaze.")
]
ModelOption: TypeAlias = Annotated[
    str | None,
    typer.Option(help="auto, homography, affine, similarity or translation."),
]
MaxFpsOption: TypeAlias = Annotated[
    float | None, typer.Option(help="Leave out pictures of a live source beyond this rate.")
]
RetriesOption: TypeAlias = Annotated[
    int | None,
    typer.Option(min=0, help="Openings of a live source in a row; default for ever."),
]
NoRecordOption: TypeAlias = Annotated[bool, typer.Option("--no-record", help="Make no recording.")]
SummaryOption: TypeAlias = Annotated[Path | None, typer.Option(help="Summary as JSON.")]
SettingsOption: TypeAlias = Annotated[
    Path | None, typer.Option(help="Settings as TOML; flags win.")
]
QuietOption: TypeAlias = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]


def merged_settings(path: Path | None, flags: dict[str, Any]) -> Settings:
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


def default_recording(source: str, *, is_series: bool) -> Path:
    """A free name with the time of start; a series has one name, so that its limits hold."""
    from streamtrack.sources.addresses import STDIN, redacted
    from streamtrack.types import SourceInfo

    address = "stdin" if source == STDIN else redacted(source)
    stem = Path(SourceInfo(address, (0, 0), None, None).name).stem or "source"
    safe = "".join(c if c.isalnum() or c in "-_." else "-" for c in stem)
    if is_series:
        return Path("recordings") / f"{safe}.rrd"
    first = Path("recordings") / f"{safe}-{time.strftime('%Y%m%d-%H%M%S')}.rrd"
    path, number = first, 1
    while path.exists():
        number += 1
        path = first.with_stem(f"{first.stem}-{number}")
    return path


def consoles() -> tuple[Console, Console]:
    from rich.console import Console

    # Piped, a table must not be wrapped, so that it can be searched.
    output = Console() if sys.stdout.isatty() else Console(width=_PIPED_WIDTH)
    return output, Console(stderr=True)


@contextmanager
def warnings_shown(errors: Console, quiet: bool) -> Iterator[None]:
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


def progress_for(errors: Console, quiet: bool) -> Any:
    from streamtrack.progress import NoProgress, ProgressBar, ProgressLines

    if quiet:
        return NoProgress()
    return ProgressBar(errors) if errors.is_terminal else ProgressLines(errors)


def print_summary(console: Console, rows: list[tuple[str, str]], record: Path | None) -> None:
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


class StopOnSignal:
    """The work of a command. True once SIGINT or SIGTERM came: it ends after the frame it is at.

    A second signal interrupts at once, for a run that hangs.
    """

    def __init__(self) -> None:
        self._came = False
        self._before: dict[int, Any] = {}

    def __call__(self) -> bool:
        return self._came

    def __enter__(self) -> StopOnSignal:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._stop)
        gc.freeze()  # what is loaded by now stays: garbage is looked for among the rest
        gc.enable()
        return self

    def __exit__(self, *exc: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self._came:
            raise KeyboardInterrupt
        self._came = True
