"""The summary of the mosaic of a stream, gathered while the Steps go by."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from streamtrack import geometry
from streamtrack.meters import LogHistogram, peak_rss_mb
from streamtrack.mosaic.stream.export import Exported
from streamtrack.mosaic.summary import LinkSummary, MosaicSummary
from streamtrack.mosaic.types import Link, Placement, Status
from streamtrack.pose_graph import ExpectedDrift, KeyframeEdge
from streamtrack.settings import Settings
from streamtrack.sources.base import FrameSource
from streamtrack.sources.live_status import LiveStatus
from streamtrack.types import Matrix, Skipped, Step
from streamtrack.watching import MosaicWatcher, Watchers

_MOST_REASONS = 1000
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

    def sigma_px(self, index: int) -> float: ...


class StreamReport:
    """What becomes of the frames of a stream, in memory that does not grow with their number."""

    def __init__(
        self, source: FrameSource, settings: Settings, graph: _Graph, watchers: Watchers
    ) -> None:
        self._began = time.perf_counter(), time.process_time()
        self._source = source
        self._settings = settings
        self._graph = graph
        self._watchers = watchers
        self._reasons: Counter[str] = Counter()
        self._features: dict[int, int] = {}
        self._ms = LogHistogram()
        self.frames = 0

    @property
    def _mosaic(self) -> MosaicWatcher:
        assert self._watchers.mosaic is not None
        return self._watchers.mosaic

    def add(self, step: Step) -> None:
        """Note a frame. Only so many different reasons are told apart."""
        self.frames += 1
        reason = self._mosaic.reason
        is_known = reason in self._reasons or len(self._reasons) < _MOST_REASONS
        self._reasons[reason if is_known else _OTHER] += 1
        self._ms.add(step.stage_ms["total"] + self._mosaic.paint_ms)
        if step.camera.is_keyframe and step.features is not None:
            self._features[step.frame.index] = len(step.features)

    def build(
        self,
        skipped: Sequence[Skipped],
        corrupt_packets: int,
        ended: str,
        live: LiveStatus | None = None,
    ) -> MosaicSummary:
        """The summary of the run, once its mosaic is complete."""
        graph, mosaic, exported = self._graph, self._mosaic.mosaic, self._mosaic.exported
        links, edges = graph.links, graph.edges
        names = {index: f"frame {index}" for index in graph.keyframes}
        placed = self._reasons[""]
        notes = (*mosaic.notes, *(exported.notes if exported is not None else ()))
        models = Counter(link.model.value for link in links if link.model is not None)
        agreement = [link.overlap_ncc for link in links if np.isfinite(link.overlap_ncc)]
        return MosaicSummary(
            source=self._source.info.name,
            settings=self._settings,
            images=self._placements(),
            links=tuple(
                LinkSummary.of(link, names, is_loop=edge.is_loop)
                for link, edge in zip(links, edges, strict=False)
            ),
            frames_used=placed,
            frames_skipped=self._skipped(skipped),
            transformation_model=models.most_common(1)[0][0] if models else None,
            projection="planar" if placed else None,
            reference=next(iter(names.values()), None),
            canvas_wh=exported.size_wh if exported is not None else None,
            scale=exported.scale if exported is not None else 1.0,
            rmse_px=_rmse_px(links, graph),
            overlap_ncc=float(np.mean(agreement)) if agreement else float("nan"),
            time_s=time.perf_counter() - self._began[0],
            cpu_s=time.process_time() - self._began[1],
            peak_rss_mb=peak_rss_mb(),
            ms_per_frame=self._ms.quantile(0.5),
            ended=ended,
            notes=notes,
            live=live,
            more=self._more(edges, exported, corrupt_packets),
        )

    def _skipped(self, skipped: Sequence[Skipped]) -> dict[str, int]:
        """Frames and pictures that were not placed, by reason, most first."""
        counts = Counter({reason: n for reason, n in self._reasons.items() if reason})
        counts.update(picture.reason for picture in skipped)
        return dict(counts.most_common())

    def _placements(self) -> tuple[Placement, ...]:
        """The keyframes, with the features that their frames had."""
        return tuple(
            Placement(
                index=index,
                name=f"frame {index}",
                features=self._features.get(index, 0),
                status=Status.USED,
                world_from_picture=keyframe.world_from_keyframe,
                time_s=keyframe.time_s,
            )
            for index, keyframe in self._graph.keyframes.items()
        )

    def _more(
        self, edges: Sequence[KeyframeEdge], exported: Exported | None, corrupt_packets: int
    ) -> dict[str, Any]:
        mosaic, p95_ms = self._mosaic.mosaic, self._ms.quantile(0.95)
        drift = ExpectedDrift.of(self._graph)
        more: dict[str, Any] = {
            "keyframes": len(self._graph.keyframes),
            "expected_drift_px": drift and round(drift.end_px, 3),
            "expected_drift_most_px": drift and round(drift.most_px, 3),
            "loops_closed": sum(edge.is_loop for edge in edges),
            "frames_painted": mosaic.figures.painted,
            "frames_kept": mosaic.views,
            "tiles": mosaic.tiles,
            "spilled_mb": round(mosaic.spilled_mb, 1),
            "ms_per_frame_p95": None if p95_ms is None else round(p95_ms, 2),
            "corrupt_packets": corrupt_packets,
        }
        if exported is not None and exported.tally.overlap:
            tally = exported.tally
            more["ghost_index"] = round(tally.contested / tally.overlap, 5)
            more["ghost_index_undecided"] = round(tally.undecided / tally.overlap, 5)
            more["ghost_index_definition"] = (
                "share of the pixels seen more than once where samples disagree; undecided: where "
                "no majority could tell what stands there"
            )
        return more


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
