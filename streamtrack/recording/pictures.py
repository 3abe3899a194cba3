"""Recording a mosaic of pictures: what was found in them, what joins them, and what came of it.

Entities:
    mosaic/image, mosaic/outlines           the mosaic, and where each picture lies in it
    pictures/<i>/image, /keypoints          each picture with its keypoints
    links/<a>-<b>/image, /matches           two pictures side by side, with lines between matches
    summary, log                            text
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from streamtrack.errors import OutputError
from streamtrack.geometry import scaling, transform_points
from streamtrack.mosaic.types import Link, Picture, Placement, Status
from streamtrack.recording import blueprint, rows, styles
from streamtrack.recording.entities import (
    INLIER,
    LOG,
    MOSAIC_IMAGE,
    OUTLIER,
    SUMMARY,
    UNMATCHED,
)
from streamtrack.recording.file import RecordingFiles, free_bytes, new_stream, reserve_bytes
from streamtrack.recording.video import jpeg_of
from streamtrack.types import Image, Points, Size, Verdict
from streamtrack.working_size import reduced

_TIMELINE = "picture"
MOSAIC_SIDE = 2048
_PICTURE_SIDE = 1024
_PAIR_SIDE = 800
_PAIR_GAP = 8
_QUALITY = 85
_MOST_IMAGE_BYTES = 1_000_000
_FLUSH_TIMEOUT_S = 30.0
_MAX_LINKS = 48
_MAX_LINES = 200
_LINKS_A_PAGE = 4
_PICTURES_A_PAGE = 12


def record_picture_mosaic(
    path: Path,
    pictures: Sequence[Picture],
    links: Sequence[Link],
    placements: Sequence[Placement],
    mosaic: Image | None,
    outlines: Mapping[int, Points],
    summary_markdown: str,
) -> None:
    """Write a mosaic of pictures, and all that led to it, to an .rrd file ready to be viewed.

    ``mosaic`` is the picture that came of it, None if none did; ``outlines`` (N, 2) run around the
    pictures in its pixels, by picture index. Pictures are recorded smaller than they are (mosaic
    2048 px a side), of many links those with the most inliers. Raises OutputError if the file
    cannot be written.
    """
    shown = sorted(links, key=lambda link: -link.registration.inliers)[:_MAX_LINKS]
    shown.sort(key=lambda link: (link.verdict is not Verdict.OK, link.a, link.b))
    by_index = {picture.index: picture for picture in pictures}
    shown = [link for link in shown if link.a in by_index and link.b in by_index]
    stream = new_stream()
    files = RecordingFiles(stream, _layout(pictures, shown, mosaic))
    _check_room(path)
    files.open(path)
    try:
        _log_styles(stream)
        stream.send_recording_name(f"Mosaic of {len(pictures)} pictures")
        if mosaic is not None:
            _log_mosaic(stream, mosaic, outlines, placements)
        for picture in pictures:
            _wait_for_room(stream, path)
            _log_picture(stream, picture)
        for link in shown:
            _wait_for_room(stream, path)
            _log_link(stream, link, by_index[link.a], by_index[link.b])
        _log_lines(stream, placements, links, len(links) - len(shown))
        document = rr.TextDocument(summary_markdown, media_type="text/markdown")
        stream.log(SUMMARY, document, static=True)
    finally:
        is_whole = files.close()
    if not is_whole:
        raise _no_room(path)


def _check_room(path: Path) -> None:
    """Raise OutputError while the file can still be ended: on a full disk Rerun waits for ever."""
    folder = path.resolve().parent
    while not folder.exists():
        folder = folder.parent
    try:
        free = free_bytes(folder)
    except OSError as error:
        raise OutputError(f"recording {path}: {error.strerror or error}") from None
    if free < reserve_bytes(_MOST_IMAGE_BYTES):
        raise _no_room(path)


def _wait_for_room(stream: rr.RecordingStream, path: Path) -> None:
    """Let what was logged reach the disk, and see that there is space for more."""
    stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
    _check_room(path)


def _no_room(path: Path) -> OutputError:
    return OutputError(
        f"cannot write {path}: no space left on the disk; free some or choose another disk"
    )


def _log_styles(stream: rr.RecordingStream) -> None:
    styles.log_styles(stream)
    for root in ("links", "pictures"):
        stream.log(root, styles.point_classes(), static=True)


def _log_mosaic(
    stream: rr.RecordingStream,
    mosaic: Image,
    outlines: Mapping[int, Points],
    placements: Sequence[Placement],
) -> None:
    factor = _factor((mosaic.shape[1], mosaic.shape[0]), MOSAIC_SIDE)
    _log_image(stream, MOSAIC_IMAGE, mosaic, factor)
    shown = [placement for placement in placements if placement.index in outlines]
    stream.log(
        "mosaic/outlines",
        rr.LineStrips2D(
            [transform_points(scaling(factor), outlines[one.index]) for one in shown],
            colors=[styles.target_color(number) for number in range(len(shown))],
            labels=[one.name for one in shown],
            show_labels=len(shown) <= _PICTURES_A_PAGE,
            radii=styles.ui_points(1.0),
            draw_order=10.0,
        ),
        static=True,
    )


def _log_picture(stream: rr.RecordingStream, picture: Picture) -> None:
    factor = _factor(picture.size_wh, _PICTURE_SIDE)
    _log_image(stream, f"pictures/{picture.index}/image", picture.image, factor)
    path = f"pictures/{picture.index}/keypoints"
    points = transform_points(scaling(factor), picture.features.points)
    classes = np.full(len(points), UNMATCHED, np.uint16)
    stream.log(path, rows.points(points, classes), static=True)
    style = rr.Points2D.from_fields(radii=styles.ui_points(1.5), show_labels=False, draw_order=20)
    stream.log(path, style, static=True)


def _log_link(stream: rr.RecordingStream, link: Link, a: Picture, b: Picture) -> None:
    """Both pictures in one, side by side, and a line for each pair; the agreeing ones on top."""
    factor_a, factor_b = _factor(a.size_wh, _PAIR_SIDE), _factor(b.size_wh, _PAIR_SIDE)
    small_a, small_b = reduced(_bgr(a.image), factor_a), reduced(_bgr(b.image), factor_b)
    left = small_a.shape[1] + _PAIR_GAP
    height = max(small_a.shape[0], small_b.shape[0])
    pair = np.full((height, left + small_b.shape[1], 3), 24, np.uint8)
    pair[: small_a.shape[0], : small_a.shape[1]] = small_a
    pair[: small_b.shape[0], left:] = small_b
    path = _link_path(link)
    _log_image(stream, f"{path}/image", pair, 1.0)

    order = np.argsort(link.registration.is_inlier, kind="stable")
    order = order[:: max(1, -(-len(order) // _MAX_LINES))]
    start = transform_points(scaling(factor_a), link.a_points[order])
    end = transform_points(scaling(factor_b), link.b_points[order]) + np.array(
        [left, 0], np.float32
    )
    lines: npt.NDArray[np.float32] = np.stack([start, end], axis=1).astype(np.float32)
    is_inlier = link.registration.is_inlier[order]
    classes = np.where(is_inlier, INLIER, OUTLIER).astype(np.uint16)
    stream.log(f"{path}/matches", rows.strips(lines, classes), static=True)
    style = rr.LineStrips2D.from_fields(
        radii=styles.ui_points(0.5), show_labels=False, draw_order=10
    )
    stream.log(f"{path}/matches", style, static=True)


def _log_lines(
    stream: rr.RecordingStream,
    placements: Sequence[Placement],
    links: Sequence[Link],
    hidden: int,
) -> None:
    """A line for each picture and for each link, at the place of the picture on the time line."""
    for placement in placements:
        stream.set_time(_TIMELINE, sequence=placement.index)
        is_used = placement.status is Status.USED
        text = f"{placement.name}: {placement.status}"
        text += f": {placement.reason}" if placement.reason else f", {placement.features} features"
        stream.log(LOG, rr.TextLog(text, level="INFO" if is_used else "WARN"))
    for link in links:
        stream.set_time(_TIMELINE, sequence=max(link.a, link.b))
        stream.log(LOG, rr.TextLog(_link_text(link), level="INFO"))
    if hidden:
        text = f"{hidden} of {len(links)} links are not shown as pictures"
        stream.log(LOG, rr.TextLog(text, level="INFO"))


def _layout(
    pictures: Sequence[Picture], links: Sequence[Link], mosaic: Image | None
) -> rrb.Blueprint:
    names = {picture.index: picture.name for picture in pictures}
    link_views = [
        rrb.Spatial2DView(
            name=_short(f"{names[link.a]} | {names[link.b]}: {_verdict(link)}"),
            origin=f"/{_link_path(link)}",
            contents=f"/{_link_path(link)}/**",
        )
        for link in links
    ]
    picture_views = [
        rrb.Spatial2DView(
            name=_short(f"{picture.name}: {len(picture.features)} features"),
            origin=f"/pictures/{picture.index}",
            contents=f"/pictures/{picture.index}/**",
        )
        for picture in pictures
    ]
    tabs = [
        *_pages(link_views, _LINKS_A_PAGE, "Matches"),
        *_pages(picture_views, _PICTURES_A_PAGE, "Pictures"),
    ]
    is_wide = mosaic is not None and mosaic.shape[1] > 2 * mosaic.shape[0]
    left: list[Any] = [rrb.Tabs(*tabs, active_tab=0)] if tabs else []
    if mosaic is not None:
        left.insert(0, rrb.Spatial2DView(name="Mosaic", origin="/mosaic", contents="/mosaic/**"))
    shares = [1.0, 1.0][: len(left)]
    views = (
        rrb.Vertical(*left, row_shares=shares)
        if is_wide
        else rrb.Horizontal(*left, column_shares=shares)
    )
    texts = blueprint.text_tabs(_TIMELINE)
    root = rrb.Horizontal(views, texts, column_shares=[4.0, 1.2])
    return blueprint.whole_layout(root, _TIMELINE)


def _pages(views: Sequence[Any], a_page: int, name: str) -> list[Any]:
    """The views in grids of a readable number."""
    pages = [views[start : start + a_page] for start in range(0, len(views), a_page)]
    return [
        rrb.Grid(
            *page,
            grid_columns=math.ceil(math.sqrt(len(page))),
            name=name if len(pages) == 1 else f"{name} {number}",
        )
        for number, page in enumerate(pages, 1)
    ]


def _log_image(stream: rr.RecordingStream, path: str, picture: Image, factor: float) -> None:
    data = jpeg_of(reduced(picture, factor), _QUALITY)
    image = rr.EncodedImage(contents=data, media_type="image/jpeg", draw_order=-10.0)
    stream.log(path, image, static=True)


def _link_path(link: Link) -> str:
    return f"links/{link.a}-{link.b}"


def _link_text(link: Link) -> str:
    return f"{link.a} - {link.b}: {len(link.matches)} matches, {_verdict(link)}"


def _verdict(link: Link) -> str:
    count = f"{link.registration.inliers} of {len(link.a_points)} agree"
    if link.verdict is not Verdict.OK:
        return f"refused ({link.verdict}), {count}"
    return f"{count}, RMSE {link.rmse_px:.2f} px"


def _short(text: str, length: int = 90) -> str:
    return text if len(text) <= length else f"...{text[-length:]}"


def _factor(size_wh: Size, side: int) -> float:
    return min(1.0, side / max(size_wh))


def _bgr(picture: Image) -> Image:
    if picture.ndim == 3:
        return picture
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR), np.uint8)
