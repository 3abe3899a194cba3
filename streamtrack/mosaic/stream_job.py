"""The mosaic of a stream from source to closed outputs: opens everything, loops, closes everything.

Whatever ends the run (the source's end, a broken source, a wish to stop), the mosaic so far is
written, with every frame's pose as it is known at the end.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING

from streamtrack.camera.moving import MovingCamera
from streamtrack.errors import OutputError, SourceError, StreamtrackError, UsageError
from streamtrack.features import FeatureExtractor
from streamtrack.frame_view import FrameView
from streamtrack.mosaic.export import Exported
from streamtrack.mosaic.job import MosaicJob, MosaicOutcome, MosaicProgress
from streamtrack.mosaic.picture_files import check_picture_path
from streamtrack.mosaic.stream import StreamMosaic
from streamtrack.mosaic.stream_summary import FrameLog, summary_of
from streamtrack.results import PosesWriter
from streamtrack.sources import open_source
from streamtrack.sources.base import FrameSource
from streamtrack.types import CameraPose, Frame, SourceInfo, Step

if TYPE_CHECKING:
    from streamtrack.recording.recorder import Recorder


def run_stream_mosaic(
    job: MosaicJob, progress: MosaicProgress, should_stop: Callable[[], bool]
) -> MosaicOutcome:
    """Run the job; all outputs are closed when it returns, whatever ended it.

    Raises StreamtrackError if it cannot even start.
    """
    _check_outputs(job)
    with ExitStack() as stack:
        wants_packets = job.outputs.record is not None
        source = stack.enter_context(open_source(job.inputs[0], with_packets=wants_packets))
        frames = _frames(job, source)
        first = next(frames, None)
        if first is None:
            raise SourceError(_nothing_read(job, source))
        run = _Run(job, source, stack)
        progress.begin("frames", _expected_frames(job, source.info))
        run.follow(chain([first], frames), progress, should_stop)
        return run.finish(progress)


class _Run:
    """One run between its first frame and its summary."""

    def __init__(self, job: MosaicJob, source: FrameSource, stack: ExitStack) -> None:
        self._began = time.perf_counter(), time.process_time()
        self._job = job
        self._source = source
        self._settings = job.settings.model_copy(update={"camera": "moving"})
        self._poses = self._recorder = None
        if job.outputs.poses is not None:
            self._poses = stack.enter_context(PosesWriter(job.outputs.poses))
        if job.outputs.record is not None:
            self._recorder = stack.enter_context(self._open_recorder(job.outputs.record))
        self._extractor = FeatureExtractor(job.settings.features)
        self._camera = MovingCamera(self._settings, is_live=source.info.is_live)
        stack.callback(self._camera.graph.close)
        stack.callback(self._camera.close)
        self._mosaic = stack.enter_context(StreamMosaic(job.settings.mosaic, self._camera.graph))
        self._log = FrameLog()
        self._error: StreamtrackError | None = None
        self._ended = ""

    def _open_recorder(self, path: Path) -> Recorder:
        from streamtrack.recording.recorder import Recorder

        return Recorder(path, self._source.info, self._settings, [], has_mosaic=True)

    def follow(
        self, frames: Iterator[Frame], progress: MosaicProgress, should_stop: Callable[[], bool]
    ) -> None:
        """Take in all frames; what ends them early is kept for the outcome."""
        try:
            for frame in frames:
                reason = self._take(frame)
                progress.advance(reason)
                if should_stop():
                    self._ended = f"interrupted after frame {frame.index}"
                    self._error = StreamtrackError(
                        f"{self._ended}: the mosaic up to there is written"
                    )
                    break
        except StreamtrackError as raised:
            self._error, self._ended = raised, str(raised)

    def _take(self, frame: Frame) -> str:
        began = time.perf_counter()
        view = FrameView(frame, self._extractor)
        pose = self._camera.update(view, ())
        placed = time.perf_counter()
        reason = self._mosaic.add(frame, pose)
        painted = time.perf_counter()
        features = view.detected
        self._log.add(frame, reason, 0 if features is None else len(features))
        stage_ms = {
            "camera": (placed - began) * 1e3,
            "mosaic": (painted - placed) * 1e3,
            "total": (painted - began) * 1e3,
        }
        self._log.add_time(stage_ms["total"])
        if self._recorder is not None:
            self._record(self._recorder, Step(frame, (), pose, features, stage_ms), reason)
        return reason

    def _record(self, recorder: Recorder, step: Step, reason: str) -> None:
        frame, pose = step.frame, step.camera
        recorder.log(step)
        state = "placed" if not reason else "lost" if pose.world_from_frame is None else "refused"
        recorder.log_mosaic_frame(
            frame.index,
            frame.time_s,
            frame.size_wh,
            None if reason else pose.world_from_frame,
            state,
            reason,
            _metrics(pose),
        )
        if recorder.is_mosaic_due(frame.time_s):
            recorder.log_mosaic(self._mosaic.view(), frame.index, frame.time_s)

    def finish(self, progress: MosaicProgress) -> MosaicOutcome:
        """Write everything; the first thing that went wrong is the outcome's error."""
        path = self._job.outputs.image
        exported: Exported | None = None
        with _Keeping(self):
            self._camera.close()  # from here on the poses are final
        with _Keeping(self):
            if path is not None:
                self._check_placed(path)
                progress.begin("writing", None)
            exported = self._mosaic.finish(path, progress.advance)
        with _Keeping(self):
            self._write_poses()
        outputs = self._job.outputs
        summary = summary_of(
            self._source,
            self._settings,
            self._log,
            self._camera.graph,
            self._mosaic,
            exported,
            self._ended or self._natural_end(),
            self._began,
        )
        with _Keeping(self):
            if outputs.summary is not None:
                summary.write_json(outputs.summary)
        if self._recorder is not None:
            last = self._log.last
            self._recorder.log_mosaic(self._mosaic.view(), *last)
            self._recorder.close(summary.to_markdown())
            if self._recorder.failed is not None:
                self.fail(
                    OutputError(
                        f"the recording {self._recorder.path} ended early "
                        f"({self._recorder.failed}); all else is complete"
                    )
                )
        return MosaicOutcome(summary, self._error)

    def _check_placed(self, path: Path) -> None:
        if not self._log.placed:
            why = ", ".join(f"{reason} {n}" for reason, n in self._log.skipped().items())
            raise OutputError(f"no frame could be placed ({why}): {path} is not written")

    def fail(self, error: StreamtrackError) -> None:
        """Keep the first error."""
        self._error = self._error or error

    def _write_poses(self) -> None:
        if self._poses is None:
            return
        graph = self._camera.graph
        for row in self._log.rows():
            pose = None if row.reason else graph.world_from_frame(row.index)
            reason = row.reason or ("" if pose is not None else "its pose was given up later")
            self._poses.write_pose(row.index, row.name, row.time_s, pose, reason)
        for skipped in self._source.skipped:
            self._poses.write_skipped(skipped)

    def _natural_end(self) -> str:
        if len(self._log) == self._job.frames:
            return f"{len(self._log)} frames, as asked"
        shortfall = self._source.shortfall
        return f"the source {shortfall}" if shortfall else "end of source"


class _Keeping:
    """Lets a run go on with its other outputs when one of them fails."""

    def __init__(self, run: _Run) -> None:
        self._run = run

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> bool:
        if isinstance(error, StreamtrackError):
            self._run.fail(error)
            return True
        return False


def _metrics(pose: CameraPose) -> dict[str, float]:
    found = {"inliers": float(pose.inliers), "rmse_px": pose.rmse_px}
    return {name: value for name, value in found.items() if math.isfinite(value)}


def _frames(job: MosaicJob, source: FrameSource) -> Iterator[Frame]:
    stop = None if job.frames is None else job.start + max(0, (job.frames - 1) * job.step + 1)
    return islice(source, job.start, stop, job.step)


def _nothing_read(job: MosaicJob, source: FrameSource) -> str:
    if job.start > 0:
        return f"{source.info.name}: the source has no frame {job.start}: it ended before"
    return f"{source.info.name}: no frame could be read"


def _expected_frames(job: MosaicJob, info: SourceInfo) -> int | None:
    if info.frame_count is None:
        return job.frames
    available = max(0, -(-(info.frame_count - job.start) // job.step))
    return available if job.frames is None else min(available, job.frames)


def _check_outputs(job: MosaicJob) -> None:
    """Refuse, before anything is opened, what cannot be right."""
    outputs = job.outputs
    if job.truth is not None:
        raise UsageError("--truth is for two pictures, and this is a stream: leave it out")
    if outputs.image is not None:
        check_picture_path(outputs.image)
    if outputs.record is not None and outputs.record.suffix != ".rrd":
        raise UsageError(f"recording {outputs.record}: give it the ending .rrd")
    taken = {Path(job.inputs[0]).resolve(): f"the source {job.inputs[0]}"}
    for name in ("image", "poses", "summary", "record"):
        path: Path | None = getattr(outputs, name)
        if path is None:
            continue
        if path.is_dir():
            raise OutputError(f"cannot write {path}: this is a folder; name a file in it")
        is_device = path.exists() and not path.is_file()
        if path.resolve() in taken and not is_device:
            raise UsageError(f"{path} would replace {taken[path.resolve()]}: name another file")
        taken[path.resolve()] = f"the {name} output"
