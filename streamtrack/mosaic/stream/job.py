"""The mosaic of a stream: a run that follows the camera alone, and its summary."""

from __future__ import annotations

from collections.abc import Callable

from streamtrack.camera.keyframes import KeyframeGraph
from streamtrack.camera.moving import CameraEstimator
from streamtrack.errors import UsageError
from streamtrack.job import TrackJob, run
from streamtrack.mosaic.job import MosaicJob, MosaicOutcome, MosaicProgress
from streamtrack.mosaic.stream.report import StreamReport
from streamtrack.sources.base import FrameSource
from streamtrack.types import SourceInfo, Step
from streamtrack.watching import Outputs, Watchers


def run_stream_mosaic(
    job: MosaicJob, progress: MosaicProgress, should_stop: Callable[[], bool]
) -> MosaicOutcome:
    """Run the job; all outputs are closed when it returns, whatever ended it.

    The mosaic so far and every frame's pose, as it is known at the end, are written then. Raises
    StreamtrackError if it cannot even start.
    """
    if job.truth is not None:
        raise UsageError("--truth is for two pictures, and this is a stream: leave it out")
    settings = job.settings.model_copy(update={"camera": "moving", "max_width": None})
    outputs = Outputs(
        record=job.outputs.record,
        poses=job.outputs.poses,
        summary=job.outputs.summary,
        mosaic=job.outputs.image,
        live=job.outputs.live,
        shows_mosaic=True,
    )

    def begin_report(
        source: FrameSource, camera: CameraEstimator, watchers: Watchers
    ) -> StreamReport:
        assert isinstance(camera.graph, KeyframeGraph)
        return StreamReport(source, settings, camera.graph, watchers)

    (stream,) = job.inputs
    following = TrackJob(stream, (), settings, outputs, job.start, job.step, job.frames)
    outcome = run(following, begin_report, _Stages(progress), should_stop)
    return MosaicOutcome(outcome.summary, outcome.error)


class _Stages:
    """Progress of a run told as that of a mosaic: its frames, then its picture."""

    def __init__(self, progress: MosaicProgress) -> None:
        self._progress = progress
        self._is_writing = False

    def begin(self, info: SourceInfo, frames: int | None) -> None:
        self._progress.begin("frames", frames)

    def advance(self, step: Step) -> None:
        self._progress.advance(step.camera.reason)

    def writing(self, text: str) -> None:
        if not self._is_writing:
            self._is_writing = True
            self._progress.begin("writing", None)
        self._progress.advance(text)
