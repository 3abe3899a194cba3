"""`streamtrack bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from streamtrack.cli.common import StopOnSignal, consoles, warnings_shown

bench = typer.Typer(
    help="Measure accuracy and cost on sequences with known truth, against peers.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@bench.command("track")
def bench_track(
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="9 scenes at 640x480, streamtrack, plane-tracker, lk-chain and prewarp-lk: about "
            "a minute.",
        ),
    ] = False,
    scenes: Annotated[
        str | None,
        typer.Option(help="Scenes of synthetic://, as blur,static; none for --pot alone."),
    ] = None,
    seeds: Annotated[
        str | None,
        typer.Option(help="Seeds of each scene, as 1,2,3; default 1. The time grows with them."),
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            help="streamtrack, harris-freak, sift, brisk, plane-tracker, lk-chain, prewarp-lk, "
            "prewarp-dis, csrt, kcf; default all."
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=3, help="Frames of each sequence; default 60 to 150.")
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
    """Track sequences with known truth by streamtrack and its peers, on the very same frames.

    Without options 17 sequences, one of each scene, 13 of 640x480 and 4 of 1280x720, 1440 frames in
    all: about a quarter of an hour for all methods, two minutes for --methods streamtrack alone.
    """
    from streamtrack.bench.command import Request, run_request, tell_on

    console, errors = consoles()
    request = Request(quick, scenes, seeds, methods, frames, pot, json_path, plot, verbose)
    with warnings_shown(errors, quiet), StopOnSignal() as stop:
        run_request(request, console, (lambda _line: None) if quiet else tell_on(errors), stop)


@bench.command("mosaic")
def bench_mosaic(
    pairs: Annotated[
        Path | None,
        typer.Option(
            help="Folder of pairs with known homography, to be run as well: img1.png .. with "
            "H1to2p .., or NAMEA.png, NAMEB.png with NAME_model.txt (B to A)."
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="A reduced set, in about a minute.")
    ] = False,
    json_path: Annotated[
        Path | None, typer.Option("--json", help="Everything that was measured, as JSON.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Tell no progress.")] = False,
) -> None:
    """Register pairs of pictures with known truth: every detector and descriptor, and peers."""
    from streamtrack.bench.command import tell_on
    from streamtrack.bench.mosaic import PairRequest, run_pair_request

    console, errors = consoles()
    request = PairRequest(pairs, quick, json_path)
    with warnings_shown(errors, quiet), StopOnSignal() as stop:
        run_pair_request(request, console, (lambda _line: None) if quiet else tell_on(errors), stop)
