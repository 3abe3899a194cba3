"""`streamtrack synth` and `streamtrack view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from streamtrack.cli.common import StopOnSignal
from streamtrack.errors import StreamtrackError


def synth(
    uri: Annotated[str, typer.Argument(metavar="URI", help="synthetic://SCENE?seed=1&frames=300")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Video file, or a folder for PNG pictures.")
    ],
    truth: Annotated[Path | None, typer.Option(help="CSV of the exact truth.")] = None,
) -> None:
    """Write a synthetic sequence and its exact truth to files."""
    from streamtrack.synth import write_synthetic

    with StopOnSignal() as stop:
        written = write_synthetic(uri, output, truth, stop)
    if stop():
        raise StreamtrackError(f"interrupted after {written} frames: these are written")


def view(
    recording: Annotated[Path, typer.Argument(metavar="FILE.rrd", help="The recording to open.")],
    web: Annotated[bool, typer.Option("--web", help="In the browser, on 127.0.0.1.")] = False,
    port: Annotated[int | None, typer.Option(help="Port of the web page.")] = None,
) -> None:
    """Open a recording in the Rerun viewer."""
    from streamtrack.viewer import view as open_viewer

    raise typer.Exit(open_viewer(recording, web=web, port=port))
