"""The mosaic of a set of pictures, from files to files.

read -> features -> links -> places -> canvas -> seams and brightness -> painted picture
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from streamtrack.errors import OutputError, SourceError, StreamtrackError, UsageError
from streamtrack.meters import peak_rss_mb
from streamtrack.mosaic.job import MosaicJob, MosaicOutcome, MosaicProgress
from streamtrack.mosaic.pairs.registering import PictureRegistrar
from streamtrack.mosaic.pictures.arrangement import Arrangement, arrange, in_full_pixels
from streamtrack.mosaic.pictures.compositing import band_count, painted_bands, plan
from streamtrack.mosaic.pictures.inputs import picture_paths
from streamtrack.mosaic.pictures.linking import link_pictures
from streamtrack.mosaic.pictures.loading import PictureSet, load_pictures
from streamtrack.mosaic.pictures.output import write_mosaic, write_poses
from streamtrack.mosaic.pictures.projection import Canvas, lay_out, natural_size
from streamtrack.mosaic.pictures.truth import measured_against, read_truth
from streamtrack.mosaic.pictures.warping import MOST_SIDE
from streamtrack.mosaic.summary import LinkSummary, MosaicSummary
from streamtrack.mosaic.types import Link, Placement, Status
from streamtrack.outputs import output_error
from streamtrack.settings import Settings
from streamtrack.types import Matrix

if TYPE_CHECKING:
    from streamtrack.mosaic.pictures.record import SmallCopy

_ABSURD_TIMES = 40  # canvas pixels per pixel of all pictures together
_FEW_FEATURES = 10
_INTERRUPTED_EARLY = "interrupted before two pictures were joined: there is no mosaic yet"


@dataclass(slots=True)
class _Result:
    """What is known so far; whatever ends the run, the summary is made of it."""

    links: list[Link] = field(default_factory=list)
    arrangement: Arrangement | None = None
    canvas: Canvas | None = None
    copy: SmallCopy | None = None
    overlap_ncc: float = float("nan")
    outside: str = ""
    notes: list[str] = field(default_factory=list)
    ended: str = ""


def run_picture_mosaic(
    job: MosaicJob, progress: MosaicProgress, should_stop: Callable[[], bool]
) -> MosaicOutcome:
    """Make the mosaic of the job's pictures; outputs are written when it returns.

    When asked to stop, what has been linked by then is placed and written. Poses and summary are
    written even if nothing could be placed. Raises StreamtrackError if it cannot start.
    """
    began, cpu_began = time.perf_counter(), time.process_time()
    paths = _checked_paths(job)
    truth = read_truth(job.truth) if job.truth is not None else None
    registrar = PictureRegistrar(job.settings)
    progress.begin("reading", len(paths))
    found = load_pictures(paths, registrar, job.settings, progress.advance, should_stop)
    result, error = _Result(), None
    try:
        if len(found.pictures) < 2:
            raise SourceError(_too_few(found))
        pictures = [found.pictures[index] for index in sorted(found.pictures)]
        matching = job.settings.matching
        result.links = link_pictures(pictures, registrar, matching, progress, should_stop)
        _place_and_paint(job, found, result, progress)
        if should_stop():
            result.ended = "interrupted: what was linked until then is written"
            error = StreamtrackError(result.ended)
    except StreamtrackError as raised:
        is_early = should_stop() and result.canvas is None
        error = StreamtrackError(_INTERRUPTED_EARLY) if is_early else raised
        result.ended = result.ended or str(error)
    images = _placements(found, result)
    summary = _summary(job, found, result, images, truth)
    summary = _timed(summary, began, cpu_began)
    failure = _write_tables(job, summary) or _record(job, found, result, summary)
    return MosaicOutcome(summary, error or failure)


def _checked_paths(job: MosaicJob) -> list[Path]:
    """The pictures of the job. Raises UsageError or SourceError where no mosaic can come of it."""
    paths = picture_paths(job.inputs)[job.start :: job.step]
    if job.outputs.live is not None:
        raise UsageError("--live shows a stream as it goes, and these are pictures: leave it out")
    paths = paths if job.frames is None else paths[: job.frames]
    if len(paths) < 2:
        raise UsageError(
            f"a mosaic needs at least two pictures, and {len(paths)} "
            f"{'was' if len(paths) == 1 else 'were'} given: name another, a folder or a glob"
        )
    if job.truth is not None and len(paths) != 2:
        raise UsageError(f"--truth is for two pictures, and there are {len(paths)}: leave it out")
    outputs = job.outputs
    taken = {path.resolve(): f"the picture {path}" for path in paths}
    for name in ("image", "poses", "summary", "record"):
        path = getattr(outputs, name)
        if path is None:
            continue
        if path.is_dir():
            raise OutputError(f"cannot write {path}: this is a folder; name a file in it")
        if path.resolve() in taken:
            raise UsageError(f"{path} would replace {taken[path.resolve()]}: name another file")
        taken[path.resolve()] = f"the {name} output"
        _check_writable(path)
    if outputs.image is not None:
        from streamtrack.mosaic.picture_files import check_picture_path

        check_picture_path(outputs.image)
    return paths


def _check_writable(path: Path) -> None:
    """Known before the work, not after it. Raises OutputError."""
    import os

    folder = path.resolve().parent
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir():
        raise output_error(path, NotADirectoryError(20, "not a folder"))
    if not os.access(folder, os.W_OK):
        raise output_error(path, PermissionError(13, "permission denied"))


def _too_few(found: PictureSet) -> str:
    reasons = "; ".join(f"{item.name} {item.reason}" for item in found.skipped[:3])
    return (
        f"{len(found.pictures)} of {len(found.paths)} pictures can be read, "
        f"two are needed: {reasons}"
    )


# -- canvas -------------------------------------------------------------------------------------


def _place_and_paint(
    job: MosaicJob, found: PictureSet, result: _Result, progress: MosaicProgress
) -> None:
    arrangement = arrange(result.links, found.sizes, job.settings)
    reference_factor = found.factors[arrangement.reference]
    result.arrangement = in_full_pixels(arrangement, found.small_from_full, found.full_sizes)
    _take_over_links(result, arrangement, found)
    canvas = _canvas(job, found, result.arrangement, 1 / reference_factor, result.notes)
    settings = job.settings.mosaic
    planned = plan(canvas, found.thumbnails, found.covers, settings)
    result.overlap_ncc = planned.overlap_ncc
    if job.outputs.image is None and job.outputs.record is None:
        result.canvas = canvas
        return
    count = band_count(canvas, settings)
    progress.begin("painting", None if count > 1 else len(canvas.patches))
    bands = painted_bands(planned, found.cache.read, settings, progress.advance)
    if job.outputs.record is not None:
        from streamtrack.mosaic.pictures.record import SmallCopy

        result.copy = SmallCopy(canvas.size_wh)
        bands = result.copy.watched(bands)
    if job.outputs.image is not None:
        result.outside = write_mosaic(job.outputs.image, canvas.size_wh, bands, count)
    else:
        deque(bands, maxlen=0)
    result.canvas = canvas


def _take_over_links(result: _Result, arrangement: Arrangement, found: PictureSet) -> None:
    """Links that the arrangement came to believe replace the refused ones, and that is said."""
    held = {(link.a, link.b): link for link in (*arrangement.links, *arrangement.contradicted)}
    for place, link in enumerate(result.links):
        now = held.get((link.a, link.b), link)
        if link.b_from_a is None and now.b_from_a is not None:
            result.notes.append(
                f"{found.name(link.a)} and {found.name(link.b)} are linked by their overlap "
                f"although by itself the link is doubtful ({link.verdict.value})"
            )
        result.links[place] = now


def _canvas(
    job: MosaicJob,
    found: PictureSet,
    arrangement: Arrangement,
    reference_scale: float,
    notes: list[str],
) -> Canvas:
    """The canvas at the reference's full scale, or smaller where limits demand (with a note).

    Raises StreamtrackError if the canvas would be absurdly larger than what there is to paint.
    """
    if len(arrangement.views) < 2:
        reasons = "; ".join(f"{found.name(i)} {why}" for i, why in arrangement.refused.items())
        raise StreamtrackError(f"no two pictures fit on one surface: {reasons}")
    width, height = (n * reference_scale for n in natural_size(arrangement.views))
    pixels = sum(w * h for w, h in found.full_sizes.values())
    if not np.isfinite(width * height) or width * height > _ABSURD_TIMES * max(pixels, 1e5):
        raise StreamtrackError(
            f"the mosaic would have {width:.0f}x{height:.0f} px for {pixels / 1e6:.1f} megapixels "
            "of pictures: it is not painted; try --projection cylindrical or another --model"
        )
    most_megapixels = job.settings.mosaic.max_megapixels
    limit = min(1.0, np.sqrt(most_megapixels * 1e6 / (width * height)))
    sides = MOST_SIDE
    if job.outputs.image is not None:
        from streamtrack.mosaic.picture_files import most_side

        sides = min(sides, most_side(job.outputs.image) or sides)
    is_long = (sides - 2) / max(width, height) < limit
    limit = float(min(limit, (sides - 2) / max(width, height)))
    canvas = lay_out(arrangement.views, reference_scale * limit)
    if limit < 1:
        reason = (
            f"longer than the {sides} px a side that can be written"
            if is_long
            else f"more than the {most_megapixels:g} that --max-megapixels allows"
        )
        notes.append(
            f"scaled down to {limit:.1%}: at full size it would have {width:.0f}x{height:.0f} px, "
            f"{width * height / 1e6:.1f} megapixels, {reason}"
        )
    return Canvas(canvas.size_wh, canvas.patches, limit)


# -- what became of each picture ----------------------------------------------------------------


def _placements(found: PictureSet, result: _Result) -> tuple[Placement, ...]:
    unread = {item.index: item.reason for item in found.skipped}
    placed = result.arrangement.world_from_picture if result.arrangement is not None else {}
    images = []
    for index in range(len(found.paths)):
        picture = found.pictures.get(index)
        features = 0 if picture is None else len(picture.features)
        if index in placed:
            image = Placement(index, found.name(index), features, Status.USED, "", placed[index])
        else:
            reason = unread.get(index) or _skip_reason(index, features, found, result)
            image = Placement(index, found.name(index), features, Status.SKIPPED, reason)
        images.append(image)
    return tuple(images)


def _skip_reason(index: int, features: int, found: PictureSet, result: _Result) -> str:
    if result.arrangement is not None and index in result.arrangement.refused:
        return result.arrangement.refused[index]
    if features < _FEW_FEATURES:
        return f"only {features} features: blank, too small or out of focus"
    own = [link for link in result.links if index in (link.a, link.b)]
    if not own:
        return "not compared with any other picture"
    best = max(own, key=lambda link: (link.b_from_a is not None, link.registration.inliers))
    other = found.name(best.b if best.a == index else best.a)
    if best.b_from_a is not None:
        contradicted = result.arrangement.contradicted if result.arrangement is not None else ()
        if best in contradicted:
            return f"its link with {other} contradicts the others"
        return f"overlaps with {other}, but not with the main part of the mosaic"
    return (
        f"no overlap found: the nearest is {other} with {best.registration.inliers} inliers of "
        f"{len(best.matches)} matches ({best.verdict.value})"
    )


# -- summary ------------------------------------------------------------------------------------


def _summary(
    job: MosaicJob,
    found: PictureSet,
    result: _Result,
    images: tuple[Placement, ...],
    truth: Matrix | None,
) -> MosaicSummary:
    arrangement = result.arrangement
    skipped = Counter(image.reason for image in images if image.status is Status.SKIPPED)
    names = {index: found.name(index) for index in range(len(found.paths))}
    contradicted = arrangement.contradicted if arrangement is not None else ()
    factor = found.factors[arrangement.reference] if arrangement is not None else 1.0
    return MosaicSummary(
        source=_source_name(job.inputs),
        settings=job.settings,
        images=images,
        links=tuple(
            _link_summary(link, link in contradicted, found, names, truth, job.settings)
            for link in result.links
        ),
        frames_used=sum(image.status is Status.USED for image in images),
        frames_skipped=dict(skipped),
        transformation_model=arrangement.model if arrangement is not None else None,
        projection=arrangement.kind if arrangement is not None else None,
        focal_px=arrangement.focal_px / factor
        if arrangement is not None and arrangement.focal_px is not None
        else None,
        reference=names[arrangement.reference] if arrangement is not None else None,
        canvas_wh=result.canvas.size_wh if result.canvas is not None else None,
        scale=result.canvas.scale if result.canvas is not None else 1.0,
        rmse_px=arrangement.rmse_px / factor if arrangement is not None else float("nan"),
        overlap_ncc=result.overlap_ncc,
        ended=result.ended,
        notes=tuple(result.notes),
        more={"outside_the_pictures": result.outside} if result.outside else {},
    )


def _link_summary(
    link: Link,
    is_contradicted: bool,
    found: PictureSet,
    names: dict[int, str],
    truth: Matrix | None,
    settings: Settings,
) -> LinkSummary:
    """The link in the pixels of the files, whatever size the pictures were registered at."""
    from dataclasses import replace

    measured: Mapping[str, float] = {}
    small_from_full, factors = found.small_from_full, found.factors
    if truth is not None:
        small_truth = small_from_full[link.b] @ truth @ np.linalg.inv(small_from_full[link.a])
        measured = measured_against(
            small_truth,
            link,
            found.pictures[link.a],
            found.pictures[link.b],
            settings.registration.inlier_threshold_px,
        )
    summary = LinkSummary.of(link, names, **measured)
    if summary.b_from_a is not None:
        full = np.linalg.inv(small_from_full[link.b]) @ summary.b_from_a @ small_from_full[link.a]
        summary = replace(summary, b_from_a=full / full[2, 2])
    factor = float(np.sqrt(factors[link.a] * factors[link.b]))
    error = None if summary.corner_error_px is None else summary.corner_error_px / factors[link.b]
    return replace(
        summary,
        rmse_px=summary.rmse_px / factor,
        corner_error_px=error,
        verdict="contradicted by other links" if is_contradicted else summary.verdict,
    )


def _source_name(inputs: Sequence[str]) -> str:
    return inputs[0] if len(inputs) == 1 else f"{inputs[0]} +{len(inputs) - 1}"


def _timed(summary: MosaicSummary, began: float, cpu_began: float) -> MosaicSummary:
    from dataclasses import replace

    return replace(
        summary,
        time_s=time.perf_counter() - began,
        cpu_s=time.process_time() - cpu_began,
        peak_rss_mb=peak_rss_mb(),
    )


def _record(
    job: MosaicJob, found: PictureSet, result: _Result, summary: MosaicSummary
) -> StreamtrackError | None:
    if job.outputs.record is None:
        return None
    from streamtrack.mosaic.pictures.record import record_run

    try:
        record_run(job.outputs.record, found, result.links, result.canvas, result.copy, summary)
    except StreamtrackError as error:
        return error
    return None


def _write_tables(job: MosaicJob, summary: MosaicSummary) -> StreamtrackError | None:
    failure: StreamtrackError | None = None
    for path, write in (
        (job.outputs.poses, lambda path: write_poses(path, summary.images)),
        (job.outputs.summary, summary.write_json),
    ):
        try:
            if path is not None:
                write(path)
        except StreamtrackError as error:
            failure = failure or error
    return failure
