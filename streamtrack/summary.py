"""The summary of a tracking run, gathered in constant memory while the Steps go by.

Names are those of the ancestor's front panel: detector, threshold, descriptor, features, matches,
inliers, transformation model. Definitions:

    features       keypoints a frame, mean over the frames in which any detection ran
    matches        point pairs behind a track (its evidence), over all tracked target-frames
    inliers        those of them that agree with the estimate
    rmse_px        mean over the tracked frames of the inliers' RMS transfer error
    budget         null without one; ``frames_at_level`` counts frames by level of work, full first,
                   ``frames_over`` those that took longer, waiting for their turn included
    automatic      targets found by their motion; ``most_at_once`` of them tracked in one frame;
                   of more than 1000 those seen last are listed
    expected_drift_px   expected RMS errors of the pictures' corners in the world, in pixels of the
                   first frame: of the last keyframe, and the largest (`mosaic.drift`)
    losses         changes from tracking to lost
    ms_per_frame   wall time of a frame, its stages together; quantiles are nearest-rank, from
                   bins 1 % wide, so right to 0.5 %; ``by_stage`` is the mean over all frames
    time_s, fps    wall time since the builder was made, and frames over it (waiting for a live
                   source included)
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from streamtrack.budget import LEVELS
from streamtrack.camera.notes import CameraNotes
from streamtrack.meters import LogHistogram, Mean, nearest_rank, peak_rss_mb
from streamtrack.pose_graph import ExpectedDrift, PoseGraph
from streamtrack.settings import Settings
from streamtrack.sources.live_status import LiveStatus
from streamtrack.summary_text import cell, markdown, number, write_json
from streamtrack.target_summary import TargetSummary, TargetSums
from streamtrack.types import AUTO_STAGE, Size, Skipped, SourceInfo, Step, Track, TrackState

_MOST_FOUND = 1000


@dataclass(frozen=True, slots=True)
class Summary:
    """What a run was, did and cost; definitions at the top of the module. Unknown is None."""

    source: str
    size_wh: Size
    settings: Settings
    frames: int
    frames_with_pose: int
    features: float | None
    matches: float | None
    matches_median: int | None
    inliers: float | None
    targets: tuple[TargetSummary, ...]
    ms_median: float | None
    ms_p95: float | None
    ms_by_stage: dict[str, float]
    frames_at_level: tuple[int, ...]
    frames_over_budget: int
    time_s: float
    peak_rss_mb: float
    skipped: tuple[Skipped, ...]
    corrupt_packets: int
    ended: str
    live: LiveStatus | None = None
    camera_notes: tuple[str, ...] = ()
    expected_drift: ExpectedDrift | None = None
    auto_at_once: int | None = None
    auto_count: int = 0

    @property
    def given(self) -> tuple[TargetSummary, ...]:
        """The targets that the user has shown."""
        return tuple(target for target in self.targets if not target.is_found)

    @property
    def fps(self) -> float | None:
        """Frames over wall time; None if there were none."""
        return self.frames / self.time_s if self.frames and self.time_s > 0 else None

    @property
    def models(self) -> dict[str, int]:
        """How many target-frames each transformation model was used for, most used first."""
        counts: Counter[str] = Counter()
        for target in self.targets:
            counts.update(target.models)
        return dict(counts.most_common())

    def to_json(self) -> dict[str, Any]:
        """Plain values under the names of the contract, null for what is unknown, never NaN.

        ``warping`` and ``blending`` are null: they belong to the summary of a mosaic.
        """
        features = self.settings.features
        return {
            "source": self.source,
            "size": {"width": self.size_wh[0], "height": self.size_wh[1]},
            "frames": self.frames,
            "detector": features.detector,
            "threshold": features.threshold_or_default,
            "descriptor": features.descriptor,
            "transformation_model": self.settings.registration.model,
            "warping": None,
            "blending": None,
            "method": self.settings.tracker.method,
            "camera": self.settings.camera,
            "camera_notes": list(self.camera_notes),
            "frames_with_pose": self.frames_with_pose,
            "expected_drift_px": self.expected_drift and self.expected_drift.to_json(),
            "features": self.features,
            "matches": {"mean": self.matches, "median": self.matches_median},
            "inliers": self.inliers,
            "models": self.models,
            "automatic_targets": self._auto_json(),
            "targets": [target.to_json() for target in self.targets],
            "ms_per_frame": {
                "median": self.ms_median,
                "p95": self.ms_p95,
                "by_stage": self.ms_by_stage,
            },
            "budget": self._budget_json(),
            "fps": self.fps,
            "time_s": self.time_s,
            "peak_rss_mb": self.peak_rss_mb,
            "skipped": [
                {"frame": item.index, "name": item.name, "reason": item.reason}
                for item in self.skipped
            ],
            "corrupt_packets": self.corrupt_packets,
            "live": None if self.live is None else self.live.to_json(),
            "ended": self.ended,
        }

    def rows(self) -> list[tuple[str, str]]:
        """(label, value) pairs for a table. Names are verbatim: escape them for markup."""
        features = self.settings.features
        used = ", ".join(f"{model} {count}" for model, count in self.models.items())
        matches = f"mean {number(self.matches, 1)}, median {number(self.matches_median, 0)}"
        camera = f"{self.settings.camera}, known in {self.frames_with_pose} frames"
        if self.settings.camera == "fixed":
            camera = "fixed" if self.camera_notes else "fixed (checked)"
        drift = () if self.expected_drift is None else (self.expected_drift.to_text(),)
        camera = "; ".join((camera, *self.camera_notes, *drift))
        ms = f"median {number(self.ms_median, 1)} ms, p95 {number(self.ms_p95, 1)} ms"
        return [
            ("Source", f"{self.source}, {self.size_wh[0]}x{self.size_wh[1]}"),
            ("Detector", features.detector),
            ("Threshold", f"{features.threshold_or_default:g}"),
            ("Descriptor", features.descriptor),
            ("Features", number(self.features, 0, " a frame", "none detected")),
            ("Matches", matches),
            ("Inliers", number(self.inliers, 1)),
            ("Transformation model", used or self.settings.registration.model),
            ("Camera", camera),
            ("Frames", str(self.frames)),
            *((f"Target {target.name}", target.to_text()) for target in self.given),
            *self._auto_rows(),
            ("Tracking time a frame", ms),
            *self._budget_rows(),
            ("Frames a second", f"{number(self.fps, 1)}, reading and writing included"),
            ("Peak memory", f"{self.peak_rss_mb:.0f} MB"),
            ("Corrupt packets", str(self.corrupt_packets)),
            *(() if self.live is None else self.live.rows()),
            ("Skipped pictures", str(len(self.skipped))),
            ("Ended", self.ended),
        ]

    def _budget_json(self) -> dict[str, Any] | None:
        budget_ms = self.settings.tracker.budget_ms
        if budget_ms is None:
            return None
        return {
            "ms": budget_ms,
            "frames_at_level": list(self.frames_at_level),
            "frames_over": self.frames_over_budget,
        }

    def _auto_json(self) -> dict[str, int] | None:
        if self.auto_at_once is None:
            return None
        return {
            "count": self.auto_count,
            "most_at_once": self.auto_at_once,
        }

    def _auto_rows(self) -> list[tuple[str, str]]:
        if self.auto_at_once is None:
            return []
        found = [target for target in self.targets if target.is_found]
        if not found:
            text = "none: nothing was seen to move by itself against a background at rest"
            return [("Automatic targets", text)]
        lives = sorted(target.frames_tracked for target in found)
        text = (
            f"{self.auto_count}, at most {self.auto_at_once} at once; tracked in "
            f"{lives[len(lives) // 2]} frames in the median, {lives[-1]} at most; "
            f"lost {sum(target.losses for target in found)} times"
        )
        return [("Automatic targets", text)]

    def _budget_rows(self) -> list[tuple[str, str]]:
        budget_ms = self.settings.tracker.budget_ms
        if budget_ms is None:
            return []
        frames = [f"level {level} {count}" for level, count in enumerate(self.frames_at_level)]
        text = (
            f"{budget_ms:g} ms, exceeded in {self.frames_over_budget} of {self.frames} frames; "
            f"frames at each level of work: {', '.join(frames)}"
        )
        return [("Time budget", text)]

    def to_markdown(self) -> str:
        """The table, and a list of the pictures that were left out."""
        lines = markdown("Tracking summary", self.rows())
        if self.skipped:
            lines += ["", "## Skipped pictures", "", "| frame | name | reason |", "|---|---|---|"]
            lines += [
                f"| {item.index} | {cell(item.name)} | {cell(item.reason)} |"
                for item in self.skipped
            ]
        return "\n".join(lines) + "\n"

    def write_json(self, path: Path) -> None:
        """Write `to_json` as a whole file or not at all. Raises OutputError."""
        write_json(path, self.to_json())


class SummaryBuilder:
    """Running sums over Steps; memory does not grow with the number of frames.

    ``clock`` gives wall seconds, ``graph`` the keyframes of a moving camera. Targets
    may appear at any time.
    """

    def __init__(
        self,
        source: SourceInfo,
        settings: Settings,
        clock: Callable[[], float] = time.perf_counter,
        graph: PoseGraph | None = None,
    ) -> None:
        self._source = source
        self._settings = settings
        self._graph = graph
        self._clock = clock
        self._started = clock()
        self._frames = 0
        self._frames_with_pose = 0
        self._camera = CameraNotes()
        self._features, self._inliers = Mean(), Mean()
        self._match_counts: Counter[int] = Counter()
        self._targets: dict[str, TargetSums] = {}
        self._auto_at_once: int | None = None
        self._auto_count = 0
        self._frames_at_level = [0] * len(LEVELS)
        self._frames_over_budget = 0
        self._ms = LogHistogram()
        self._stage_ms: dict[str, float] = {}

    @property
    def frames(self) -> int:
        """How many frames were taken in."""
        return self._frames

    def add(self, step: Step) -> None:
        """Take in one frame."""
        self._frames += 1
        self._frames_at_level[step.work_level] += 1
        self._frames_with_pose += step.camera.world_from_frame is not None
        self._camera.follow(step)
        if step.features is not None:
            self._features.add(len(step.features))
        for track in step.tracks:
            self._add_track(track, step.frame.index)
        if AUTO_STAGE in step.stage_ms:
            found = sum(track.is_found and track.quad is not None for track in step.tracks)
            self._auto_at_once = max(found, self._auto_at_once or 0)
        self._add_times(step.stage_ms, step.frame.waited_s * 1e3)

    def _add_track(self, track: Track, frame: int) -> None:
        if track.name not in self._targets:
            self._targets[track.name] = TargetSums(track.name)
            if track.is_found:
                self._auto_count += 1
                self._forget_found()
        self._targets[track.name].add(track, frame)
        if track.state is TrackState.TRACKING and not track.is_found:
            self._match_counts[len(track.evidence)] += 1
            self._inliers.add(track.evidence.inliers)

    def _forget_found(self) -> None:
        """Of very many automatic targets only those seen last are remembered."""
        found = [target for target in self._targets.values() if target.is_found]
        if len(found) >= _MOST_FOUND:
            oldest = min(found, key=lambda target: target.last_seen or 0)
            del self._targets[oldest.name]

    def _add_times(self, stage_ms: dict[str, float], waited_ms: float) -> None:
        stages = {name: ms for name, ms in stage_ms.items() if name != "total"}
        total_ms = stage_ms.get("total", sum(stages.values()))
        self._ms.add(total_ms)
        budget_ms = self._settings.tracker.budget_ms
        self._frames_over_budget += budget_ms is not None and total_ms + waited_ms > budget_ms
        for name, ms in stages.items():
            if math.isfinite(ms):
                self._stage_ms[name] = self._stage_ms.get(name, 0.0) + ms

    def build(
        self,
        skipped: Sequence[Skipped],
        corrupt_packets: int,
        ended: str,
        live: LiveStatus | None = None,
    ) -> Summary:
        """The summary so far; ``ended`` says in words why the run ended.

        ``live`` is the status of a live source.
        """
        counts = self._match_counts
        pairs = sum(matches * times for matches, times in counts.items())
        return Summary(
            source=self._source.name,
            size_wh=self._source.size_wh,
            settings=self._settings,
            frames=self._frames,
            frames_with_pose=self._frames_with_pose,
            features=self._features.value,
            matches=pairs / counts.total() if counts else None,
            matches_median=nearest_rank(counts, 0.5),
            inliers=self._inliers.value,
            targets=tuple(target.build() for target in self._targets.values()),
            ms_median=self._ms.quantile(0.5),
            ms_p95=self._ms.quantile(0.95),
            ms_by_stage={name: ms / self._frames for name, ms in self._stage_ms.items()},
            frames_at_level=tuple(self._frames_at_level),
            frames_over_budget=self._frames_over_budget,
            time_s=self._clock() - self._started,
            peak_rss_mb=peak_rss_mb(),
            skipped=tuple(skipped),
            corrupt_packets=corrupt_packets,
            ended=ended,
            live=live,
            camera_notes=self._camera.all(),
            expected_drift=ExpectedDrift.of(self._graph),
            auto_at_once=self._auto_at_once,
            auto_count=self._auto_count,
        )
