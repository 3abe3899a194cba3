"""A mosaic run, be it of pictures or of a stream."""

from __future__ import annotations

from collections.abc import Callable

from streamtrack.mosaic.job import MosaicJob, MosaicOutcome, MosaicProgress


def run_mosaic(
    job: MosaicJob, progress: MosaicProgress, should_stop: Callable[[], bool]
) -> MosaicOutcome:
    """Run the job, of pictures or of a stream; all outputs are closed when it returns.

    Raises StreamtrackError if it cannot even start or an output cannot be written.
    """
    if is_of_stream(job):
        from streamtrack.mosaic.stream.job import run_stream_mosaic

        return run_stream_mosaic(job, progress, should_stop)
    from streamtrack.mosaic.pictures.job import run_picture_mosaic

    return run_picture_mosaic(job, progress, should_stop)


def is_of_stream(job: MosaicJob) -> bool:
    """Is the job that of one stream, not of pictures?"""
    from streamtrack.mosaic.pictures.inputs import is_stream

    return len(job.inputs) == 1 and is_stream(job.inputs[0])
