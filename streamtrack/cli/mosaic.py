"""`streamtrack mosaic`.

Its annotations are no strings (`from __future__ import annotations`): Typer would evaluate each of
them three times.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from streamtrack.cli.common import (
    DescriptorOption,
    DetectorOption,
    MaxFpsOption,
    ModelOption,
    NoRecordOption,
    QuietOption,
    RetriesOption,
    SettingsOption,
    StopOnSignal,
    SummaryOption,
    ThresholdOption,
    merged_settings,
)
from streamtrack.cli.plain import plain_summary, stage_progress_for, warnings_on_stderr
from streamtrack.errors import UsageError
from streamtrack.sources.addresses import path_of

if TYPE_CHECKING:
    from streamtrack.settings import Settings


def mosaic(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="INPUT...",
            parser=path_of,
            help="Pictures, folders or globs of them; or one stream: video file, /dev/videoN, "
            "rtsp://..., synthetic://...",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The mosaic: .png, .jpg, .tif, .webp or .bmp."),
    ] = None,
    detector: DetectorOption = None,
    threshold: ThresholdOption = None,
    descriptor: DescriptorOption = None,
    model: ModelOption = None,
    warping: Annotated[
        str | None, typer.Option(help="Backward: nearest, linear, cubic or lanczos.")
    ] = None,
    blending: Annotated[
        str | None, typer.Option(help="none, average, feather or multiband.")
    ] = None,
    projection: Annotated[
        str | None, typer.Option(help="auto, planar, cylindrical or spherical.")
    ] = None,
    max_megapixels: Annotated[
        float | None, typer.Option(help="A larger mosaic is scaled down to this.")
    ] = None,
    max_memory: Annotated[
        float | None, typer.Option(help="MB for pictures and canvas; more goes by way of the disk.")
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(help="Text with the true homography, first picture to second: nine numbers."),
    ] = None,
    poses: Annotated[Path | None, typer.Option(help="CSV of where each picture lies.")] = None,
    summary: SummaryOption = None,
    record: Annotated[
        Path | None, typer.Option(help="Recording for the Rerun viewer (.rrd).")
    ] = None,
    no_record: NoRecordOption = False,
    live: Annotated[
        str | None,
        typer.Option(
            metavar="[[ADDRESS:]PORT]",
            help="Show a stream's mosaic as it grows, in a browser or Rerun viewer: at "
            "127.0.0.1:9876 if no address follows.",
        ),
    ] = None,
    max_fps: MaxFpsOption = None,
    retries: RetriesOption = None,
    settings: SettingsOption = None,
    start: Annotated[int, typer.Option(min=0, help="First frame or picture, from 0.")] = 0,
    step: Annotated[int, typer.Option(min=1, help="Use every n-th.")] = 1,
    frames: Annotated[int | None, typer.Option(min=1, help="Use at most n.")] = None,
    quiet: QuietOption = False,
) -> None:
    """Join pictures, or the frames of a stream, into one picture, and say how well they fit."""
    if not any((output, poses, summary, record, live is not None)):
        raise UsageError("nothing would be written: name the mosaic, as in --output mosaic.png")
    if no_record and record is not None:
        raise UsageError("--record and --no-record contradict each other: give one of them")
    chosen = _settings(
        settings,
        (detector, threshold, descriptor),
        model,
        {
            "warping": warping,
            "blending": blending,
            "projection": projection,
            "max_megapixels": max_megapixels,
            "max_memory_mb": max_memory,
        },
        {"max_fps": max_fps, "retries": retries},
    )
    from streamtrack.mosaic.job import MosaicJob, MosaicOutputs
    from streamtrack.mosaic.running import is_of_stream, run_mosaic

    address = None
    if live is not None:
        from streamtrack.recording.live_server import parse_live

        address = parse_live(live)
    job = MosaicJob(
        tuple(inputs),
        chosen,
        MosaicOutputs(output, poses, summary, record, address),
        truth,
        start,
        step,
        frames,
    )
    if address is not None and is_of_stream(job) and not quiet:
        # Said before it is there, as it is of no use unknown.
        sys.stdout.write(f"Watch it: {address.page_url}\n")
        sys.stdout.flush()
    with (
        warnings_on_stderr(quiet),
        stage_progress_for(quiet) as progress,
        StopOnSignal() as stop,
    ):
        outcome = run_mosaic(job, progress, stop)
    if not quiet:
        is_recorded = record is not None and record.exists()
        plain_summary(outcome.summary.rows(), record if is_recorded else None)
    if outcome.error is not None:
        raise outcome.error


def _settings(
    path: Path | None,
    features: tuple[str | None, float | None, str | None],
    model: str | None,
    mosaic_flags: dict[str, str | float | None],
    live_flags: dict[str, float | int | None],
) -> "Settings":
    names = ("detector", "threshold", "descriptor")
    return merged_settings(
        path,
        {
            "features": dict(zip(names, features, strict=True)),
            "registration": {"model": model},
            "mosaic": mosaic_flags,
            "live": live_flags,
        },
    )
