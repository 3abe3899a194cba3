"""What became of each frame of a stream, in little memory, and the summary of its mosaic."""

from __future__ import annotations

import time
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from streamtrack import geometry
from streamtrack.meters import LogHistogram, Mean, peak_rss_mb
from streamtrack.mosaic.export import Exported
from streamtrack.mosaic.stream import StreamMosaic
from streamtrack.mosaic.summary import LinkSummary, MosaicSummary
from streamtrack.mosaic.types import KeyframeEdge, Link, Placement, Status
from streamtrack.settings import Settings
from streamtrack.sources.base import FrameSource
from streamtrack.types import Frame, Matrix


@dataclass(frozen=True, slots=True)
class FrameRow:
    """One frame; ``reason`` is empty if it was placed."""

    index: int
    name: str
    time_s: float
    reason: str
    features: int


class FrameLog:
    """Every frame's fate at about 24 bytes a frame, so that a day of video is a few megabytes."""

    def __init__(self) -> None:
        self._indices = array("q")
        self._times = array("d")
        self._reasons = array("H")
        self._features = array("i")
        self._names: dict[int, str] = {}
        self._texts: list[str] = [""]
        self._ms = LogHistogram()
        self._mean_ms = Mean()
        self.placed = 0

    def __len__(self) -> int:
        return len(self._indices)

    def add(self, frame: Frame, reason: str, features: int) -> None:
        """Note a frame. Only so many different reasons are told apart."""
        if reason not in self._texts:
            self._texts.append(reason if len(self._texts) < _MOST_TEXTS else _OTHER)
        at = self._texts.index(reason) if reason in self._texts else len(self._texts) - 1
        self._indices.append(frame.index)
        self._times.append(frame.time_s)
        self._reasons.append(at)
        self._features.append(features)
        if frame.name:
            self._names[frame.index] = frame.name
        self.placed += not reason

    def add_time(self, milliseconds: float) -> None:
        """Note what a frame cost."""
        self._ms.add(milliseconds)
        self._mean_ms.add(milliseconds)

    @property
    def last(self) -> tuple[int, float]:
        """Index and time of the last frame."""
        return self._indices[-1], self._times[-1]

    @property
    def median_ms(self) -> float | None:
        return self._ms.quantile(0.5)

    @property
    def p95_ms(self) -> float | None:
        return self._ms.quantile(0.95)

    def rows(self) -> Iterator[FrameRow]:
        """All frames in order."""
        for index, time_s, reason, features in zip(
            self._indices, self._times, self._reasons, self._features, strict=True
        ):
            yield FrameRow(index, self._names.get(index, ""), time_s, self._texts[reason], features)

    def skipped(self) -> dict[str, int]:
        """Frames that were not placed, by reason, most first."""
        counts = Counter(self._reasons)
        named: Counter[str] = Counter()
        for reason, count in counts.items():
            if reason:
                named[self._texts[reason]] += count
        return dict(named.most_common())


_MOST_TEXTS = 1000
_OTHER = "another reason"


class _Keyframe(Protocol):
    @property
    def time_s(self) -> float: ...

    @property
    def world_from_keyframe(self) -> Matrix: ...


class _Graph(Protocol):
    @property
    def keyframes(self) -> Mapping[int, _Keyframe]: ...

    @property
    def links(self) -> Sequence[Link]: ...

    @property
    def edges(self) -> Sequence[KeyframeEdge]: ...


def summary_of(
    source: FrameSource,
    settings: Settings,
    log: FrameLog,
    graph: _Graph,
    mosaic: StreamMosaic,
    exported: Exported | None,
    ended: str,
    began: tuple[float, float],
) -> MosaicSummary:
    """The summary of a run; ``began`` is its start on the wall's and on the processor's clock."""
    links, edges = graph.links, graph.edges
    names = {index: f"frame {index}" for index in graph.keyframes}
    skipped = log.skipped()
    for picture in source.skipped:
        skipped[picture.reason] = skipped.get(picture.reason, 0) + 1
    notes = (*mosaic.notes, *(exported.notes if exported is not None else ()))
    models = Counter(link.model.value for link in links if link.model is not None)
    agreement = [link.overlap_ncc for link in links if np.isfinite(link.overlap_ncc)]
    return MosaicSummary(
        source=source.info.name,
        settings=settings,
        images=_placements(log, graph),
        links=tuple(
            LinkSummary.of(link, names, is_loop=edge.is_loop)
            for link, edge in zip(links, edges, strict=False)
        ),
        frames_used=log.placed,
        frames_skipped=skipped,
        transformation_model=models.most_common(1)[0][0] if models else None,
        projection="planar" if log.placed else None,
        reference=next(iter(names.values()), None),
        canvas_wh=exported.size_wh if exported is not None else None,
        scale=exported.scale if exported is not None else 1.0,
        rmse_px=_rmse_px(links, graph),
        overlap_ncc=float(np.mean(agreement)) if agreement else float("nan"),
        time_s=time.perf_counter() - began[0],
        cpu_s=time.process_time() - began[1],
        peak_rss_mb=peak_rss_mb(),
        ms_per_frame=log.median_ms,
        ended=ended,
        notes=notes,
        more=_more(log, edges, graph, mosaic, exported),
    )


def _placements(log: FrameLog, graph: _Graph) -> tuple[Placement, ...]:
    """The keyframes, with the features that their frames had."""
    keyframes = graph.keyframes
    features = {row.index: row for row in log.rows() if row.index in keyframes}
    return tuple(
        Placement(
            index=index,
            name=f"frame {index}",
            features=features[index].features if index in features else 0,
            status=Status.USED,
            world_from_picture=keyframe.world_from_keyframe,
            time_s=keyframe.time_s,
        )
        for index, keyframe in keyframes.items()
    )


def _rmse_px(links: Sequence[Link], graph: _Graph) -> float:
    """Symmetric transfer RMSE of all inliers with the keyframes where they lie at the end."""
    total, count = 0.0, 0
    keyframes = graph.keyframes
    for link in links:
        if link.a not in keyframes or link.b not in keyframes or link.b_from_a is None:
            continue
        world_from_a = keyframes[link.a].world_from_keyframe
        world_from_b = keyframes[link.b].world_from_keyframe
        b_from_a = geometry.inverted(world_from_b) @ world_from_a
        agrees = link.registration.is_inlier
        a, b = link.a_points[agrees], link.b_points[agrees]
        there = geometry.transform_points(b_from_a, a) - b
        back = geometry.transform_points(geometry.inverted(b_from_a), b) - a
        errors = np.sum(there**2, axis=1) + np.sum(back**2, axis=1)
        total += float(np.sum(errors[np.isfinite(errors)]))
        count += int(np.count_nonzero(np.isfinite(errors)))
    return float(np.sqrt(total / (2 * count))) if count else float("nan")


def _more(
    log: FrameLog,
    edges: Sequence[KeyframeEdge],
    graph: _Graph,
    mosaic: StreamMosaic,
    exported: Exported | None,
) -> dict[str, Any]:
    figures = mosaic.figures
    more: dict[str, Any] = {
        "keyframes": len(graph.keyframes),
        "loops_closed": sum(edge.is_loop for edge in edges),
        "frames_painted": figures.painted,
        "frames_kept": mosaic.views,
        "tiles": mosaic.tiles,
        "spilled_mb": round(mosaic.spilled_mb, 1),
        "ms_per_frame_p95": None if log.p95_ms is None else round(log.p95_ms, 2),
    }
    if exported is not None and exported.tally.overlap:
        tally = exported.tally
        more["ghost_index"] = round(tally.contested / tally.overlap, 5)
        more["ghost_index_undecided"] = round(tally.undecided / tally.overlap, 5)
        more["ghost_index_definition"] = (
            "share of the pixels seen more than once where samples disagree; undecided: where no "
            "majority could tell what stands there"
        )
    return more
