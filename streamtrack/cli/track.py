"""`streamtrack track`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

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
    consoles,
    default_recording,
    merged_settings,
    print_summary,
    progress_for,
    warnings_shown,
)
from streamtrack.errors import UsageError
from streamtrack.sources.addresses import path_of


def track(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            parser=path_of,
            help="Video file, folder or glob of pictures, /dev/videoN (see streamtrack devices), "
            "v4l2://, rtsp://, http(s)://, udp://, - for standard input, or "
            "synthetic://SCENE?seed=1&frames=300.",
        ),
    ],
    target: Annotated[
        list[str] | None,
        typer.Option(
            help="[NAME=]x,y,w,h or [NAME=]x1,y1,...,x4,y4 in pixels of the first frame, or "
            "[NAME=]PICTURE[@region of it] to search for, or auto: all that moves. May repeat; "
            "not needed with --mosaic, --poses or --stabilize.",
        ),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(help="hybrid (predict, warp back, flow) or detect (every frame by itself)."),
    ] = None,
    budget: Annotated[
        float | None,
        typer.Option(
            metavar="MS",
            help="Keep the time a frame near MS by doing less, in four levels: all; half the area "
            "and features; a third of the features, lost targets searched for in every second "
            "frame; a quarter, every fourth. Of a live source it counts from when the frame lay "
            "ready. The summary says how often it was exceeded. Results then depend on the "
            "machine's speed.",
        ),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            help="fixed (watched, and said if it is not), moving, or auto: finds out, also when it "
            "changes. Default fixed; auto with --target auto and where --mosaic, --stabilize, "
            "--poses, --scale or --ground ask for the world.",
        ),
    ] = None,
    scale: Annotated[
        float | None,
        typer.Option(
            metavar="PX_PER_UNIT",
            help="World pixels in one unit (metre ...): adds ground_x, ground_y and "
            "speed_units_s to --output.",
        ),
    ] = None,
    ground: Annotated[
        list[str] | None,
        typer.Option(
            metavar="x,y=X,Y",
            help="Where a pixel of the first frame lies on the ground, in units; four or more, "
            "fitted by least squares. Adds the same columns.",
        ),
    ] = None,
    detector: DetectorOption = None,
    threshold: ThresholdOption = None,
    descriptor: DescriptorOption = None,
    model: ModelOption = None,
    record: Annotated[
        Path | None,
        typer.Option(help="Recording; default recordings/<source>-<start time>.rrd."),
    ] = None,
    no_record: NoRecordOption = False,
    record_video: Annotated[
        str | None,
        typer.Option(help="Picture in the recording: auto (copy packets), jpeg, av1 or none."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(help="Table of tracks: .csv, .jsonl, .parquet, or .txt (MOT)."),
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="CSV of the camera's poses, each with the error to expect.")
    ] = None,
    video: Annotated[
        Path | None, typer.Option(help="Annotated copy, without sound: .mp4, .mkv, .webm, .avi.")
    ] = None,
    mosaic: Annotated[
        Path | None,
        typer.Option(help="What the camera saw, without the targets: .png, .jpg, .tif."),
    ] = None,
    stabilize: Annotated[
        Path | None,
        typer.Option(
            help="The video held still, without its sound: .mp4, .mkv, .webm, .avi. Every frame "
            "is shown at its time; those without a known pose are counted."
        ),
    ] = None,
    stabilize_path: Annotated[
        str | None,
        typer.Option(
            help="smooth (default): the camera's way without its shaking, cropped by 6 per cent a "
            "side; world: the place that the first frame showed, what a frame does not reach "
            "darkened, as it was seen last.",
        ),
    ] = None,
    live: Annotated[
        str | None,
        typer.Option(
            metavar="[[ADDRESS:]PORT]",
            help="Show the run as it goes, in a browser or Rerun viewer: at 127.0.0.1:9876 if no "
            "address follows.",
        ),
    ] = None,
    rotate: Annotated[
        str | None,
        typer.Option(help="Begin a new recording after 100MB, 10min, or both: 100MB|10min."),
    ] = None,
    keep: Annotated[
        str | None, typer.Option(help="Remove the oldest of them beyond 2GB, 7d, or both.")
    ] = None,
    max_width: Annotated[
        int | None,
        typer.Option(
            metavar="PX",
            help="Work on wider pictures at this width; results stay in pixels of the source.",
        ),
    ] = None,
    max_fps: MaxFpsOption = None,
    retries: RetriesOption = None,
    summary: SummaryOption = None,
    settings: SettingsOption = None,
    start: Annotated[int, typer.Option(min=0, help="First frame, counted from 0.")] = 0,
    step: Annotated[int, typer.Option(min=1, help="Use every n-th frame.")] = 1,
    frames: Annotated[int | None, typer.Option(min=1, help="Use at most n frames.")] = None,
    quiet: QuietOption = False,
) -> None:
    """Follow targets through a video and write a recording, tables and a summary."""
    from streamtrack.ground import make_ground, parse_ground
    from streamtrack.settings import WorldSettings
    from streamtrack.targets import auto_target, parse_targets

    known = parse_ground(ground) if ground else None
    if stabilize_path is not None and stabilize is None:
        raise UsageError("--stabilize-path says how: give --stabilize FILE.mp4 as well")
    if scale is not None and known is not None:
        raise UsageError("--scale and --ground contradict each other: give one of them")
    chosen = merged_settings(
        settings,
        {
            "features": {"detector": detector, "threshold": threshold, "descriptor": descriptor},
            "registration": {"model": model},
            "tracker": {"method": method, "budget_ms": budget},
            "camera": camera,
            "max_width": max_width,
            "world": {"px_per_unit": scale, "ground": known},
            "stabilize": {"path": stabilize_path},
            "recording": {"video": record_video, "rotate": rotate, "keep": keep},
            "live": {"max_fps": max_fps, "retries": retries},
        },
    )
    make_ground(chosen.world)  # what is wrong with the known points is said at once
    if not (target or mosaic or poses or stabilize):
        raise UsageError(
            "nothing to follow: give --target x,y,w,h or --target auto; for the camera alone "
            "--mosaic, --poses or --stabilize"
        )
    targets = parse_targets(target or [])
    finds_targets = auto_target(targets) is not None  # against the background, wherever that goes
    is_world_wanted = bool(mosaic or poses or stabilize or chosen.world != WorldSettings())
    if (finds_targets or is_world_wanted) and "camera" not in chosen.model_fields_set:
        chosen = chosen.model_copy(update={"camera": "auto"})
    from streamtrack.job import TrackJob, run_track
    from streamtrack.recording.live_server import parse_live
    from streamtrack.watching import Outputs

    if no_record and record is not None:
        raise UsageError("--record and --no-record contradict each other: give one of them")
    if not no_record and record is None:
        record = default_recording(source, is_series=chosen.recording.rotate is not None)
    address = None if live is None else parse_live(live)
    job = TrackJob(
        source,
        targets,
        chosen,
        Outputs(
            None if no_record else record, output, poses, video, summary, mosaic, address, stabilize
        ),
        start,
        step,
        frames,
    )
    console, errors = consoles()
    if address is not None and not quiet:
        console.print(f"Watch it: {address.page_url}", soft_wrap=True, markup=False)
    with (
        warnings_shown(errors, quiet),
        progress_for(errors, quiet) as progress,
        StopOnSignal() as stop,
    ):
        outcome = run_track(job, progress, stop)
    if not quiet:
        shown = job.outputs.record
        if shown is not None and chosen.recording.rotate is not None:
            shown = max(shown.parent.glob(f"{shown.stem}-[0-9]*.rrd"), default=shown)
        print_summary(console, outcome.summary.rows(), shown)
    if outcome.error is not None:
        raise outcome.error
