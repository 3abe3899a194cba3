"""The summary of a mosaic, of pictures or of a stream.

Names are those of the ancestor's front panel. Definitions:

    matches        pairs that the descriptor matching gave (mutual nearest, ratio test)
    pairs          point pairs that the estimate was made of, guided ones included
    inliers        those of the pairs that agree within ``inlier_threshold_px``
    rmse_px        symmetric transfer RMSE of the inliers of one link,
                   sqrt(sum(|H a - b|^2 + |H^-1 b - a|^2) / 2 n); of the mosaic: residuals of all
                   inliers after the global adjustment. Bounded by the threshold: read with it
    recall         correct matches / correspondences, one_minus_precision false / all matches
                   (Mikolajczyk & Schmid 2005), against a true homography, within the threshold
    corner_error   mean distance of a's four corners under the estimate and under the truth
    overlap_ncc    normalised cross-correlation of grey values where two pictures overlap
    canvas         size of the written picture; ``scale`` its pixels per pixel of the world
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from streamtrack.mosaic.types import Link, Placement, Status
from streamtrack.settings import Settings
from streamtrack.summary_text import known, markdown, number, write_json
from streamtrack.types import Matrix, Size

if TYPE_CHECKING:
    from streamtrack.sources.live_status import LiveStatus

_MORE_LABELS = {
    "expected_drift_px": ("Expected drift at the end", " px"),
    "expected_drift_most_px": ("Expected drift at most", " px"),
    "spilled_mb": ("Spilled to disk", " MB"),
    "ms_per_frame_p95": ("Time a frame, p95", " ms"),
    "ghost_index_undecided": ("Ghost index, undecided", ""),
}
_LONG_LIST = 40
"""So many pictures are named one by one in the printed table; beyond, only those left out."""


@dataclass(frozen=True, slots=True, eq=False)
class LinkSummary:
    """One link between two pictures, by their indices and names; definitions at the top.

    ``verdict`` is ``ok`` or why the link was refused. What was not measured is NaN or None.
    """

    a: int
    b: int
    a_name: str
    b_name: str
    matches: int
    pairs: int
    inliers: int
    rmse_px: float
    overlap_ncc: float
    model: str
    verdict: str
    b_from_a: Matrix | None
    is_loop: bool = False
    recall: float | None = None
    one_minus_precision: float | None = None
    corner_error_px: float | None = None

    @classmethod
    def of(cls, link: Link, names: dict[int, str], **measured: Any) -> LinkSummary:
        """The summary of a link; ``names`` by picture index."""
        return cls(
            a=link.a,
            b=link.b,
            a_name=names.get(link.a, str(link.a)),
            b_name=names.get(link.b, str(link.b)),
            matches=len(link.matches),
            pairs=len(link.a_points),
            inliers=link.registration.inliers,
            rmse_px=link.rmse_px,
            overlap_ncc=link.overlap_ncc,
            model=link.model.value if link.model is not None else "",
            verdict=link.verdict.value,
            b_from_a=link.b_from_a,
            **measured,
        )

    def to_json(self, threshold_px: float) -> dict[str, Any]:
        """Plain values, null for what is unknown."""
        matrix = None if self.b_from_a is None else np.asarray(self.b_from_a).tolist()
        return {
            "a": self.a,
            "b": self.b,
            "a_name": self.a_name,
            "b_name": self.b_name,
            "matches": self.matches,
            "pairs": self.pairs,
            "inliers": self.inliers,
            "inlier_share": known(self.inliers / self.pairs if self.pairs else math.nan),
            "inlier_threshold_px": threshold_px,
            "rmse_px": known(self.rmse_px),
            "rmse_definition": "symmetric transfer RMSE of the inliers, in px of each picture",
            "overlap_ncc": known(self.overlap_ncc),
            "model": self.model or None,
            "verdict": self.verdict,
            "is_loop": self.is_loop,
            "recall": known(self.recall),
            "one_minus_precision": known(self.one_minus_precision),
            "recall_definition": "correct matches / correspondences (Mikolajczyk & Schmid 2005)",
            "corner_error_px": known(self.corner_error_px),
            "b_from_a": matrix,
        }


@dataclass(frozen=True, slots=True, eq=False)
class MosaicSummary:
    """What a mosaic was made of, how well it fits and what it cost.

    ``images`` are the pictures, or the keyframes of a stream. ``frames_used`` and
    ``frames_skipped`` (frames by reason) count pictures or all frames of a stream.
    ``canvas_wh`` is None if nothing was painted. ``notes`` are said warnings (canvas scaled down).
    """

    source: str
    settings: Settings
    images: tuple[Placement, ...]
    links: tuple[LinkSummary, ...]
    frames_used: int
    frames_skipped: dict[str, int]
    transformation_model: str | None = None
    projection: str | None = None
    focal_px: float | None = None
    reference: str | None = None
    canvas_wh: Size | None = None
    scale: float = 1.0
    rmse_px: float = math.nan
    overlap_ncc: float = math.nan
    time_s: float = math.nan
    cpu_s: float = math.nan
    peak_rss_mb: float = math.nan
    ms_per_frame: float | None = None
    ended: str = ""
    notes: tuple[str, ...] = ()
    live: LiveStatus | None = None
    more: dict[str, Any] = field(default_factory=dict)
    """Further figures for JSON and table, by snake_case name (loops closed, tiles ...)."""

    def to_json(self) -> dict[str, Any]:
        """Plain values under the names of the contract, null for what is unknown, never NaN."""
        features, mosaic = self.settings.features, self.settings.mosaic
        threshold_px = self.settings.registration.inlier_threshold_px
        canvas = self.canvas_wh
        return {
            "source": self.source,
            "detector": features.detector,
            "threshold": features.threshold_or_default,
            "descriptor": features.descriptor,
            "transformation_model": self.transformation_model,
            "warping": mosaic.warping,
            "blending": mosaic.blending,
            "projection": self.projection,
            "focal_px": known(self.focal_px),
            "reference": self.reference,
            "images": [_image_json(image) for image in self.images],
            "links": [link.to_json(threshold_px) for link in self.links],
            "frames": {"used": self.frames_used, "skipped": dict(self.frames_skipped)},
            "canvas": None
            if canvas is None
            else {"width": canvas[0], "height": canvas[1], "scale": self.scale},
            "rmse_px": known(self.rmse_px),
            "overlap_ncc": known(self.overlap_ncc),
            "time_s": known(self.time_s),
            "cpu_s": known(self.cpu_s),
            "ms_per_frame": known(self.ms_per_frame),
            "peak_rss_mb": known(self.peak_rss_mb),
            "ended": self.ended,
            "notes": list(self.notes),
            "live": None if self.live is None else self.live.to_json(),
            **self.more,
        }

    def rows(self) -> list[tuple[str, str]]:
        """(label, value) pairs for a table. Names are verbatim: escape them for markup."""
        features, mosaic = self.settings.features, self.settings.mosaic
        rows = [
            ("Source", self.source),
            ("Detector", features.detector),
            ("Threshold", f"{features.threshold_or_default:g}"),
            ("Descriptor", features.descriptor),
            *self._evidence_rows(),
            ("Transformation model", self.transformation_model or self._no_model_text()),
            ("Projection", self._projection_text()),
            ("Warping", f"backward, {mosaic.warping}"),
            ("Blending", mosaic.blending),
            ("RMSE of the mosaic", number(self.rmse_px, 2, " px")),
            ("Overlap NCC", number(self.overlap_ncc, 3)),
            *self._image_rows(),
            ("Mosaic", self._canvas_text()),
        ]
        rows += [
            _more_row(key, value)
            for key, value in self.more.items()
            if not key.endswith("_definition")
        ]
        rows += [("Note", note) for note in self.notes]
        if self.ms_per_frame is not None:
            rows.append(("Time a frame", f"{self.ms_per_frame:.1f} ms"))
        rows += [] if self.live is None else self.live.rows()
        rows.append(("Time", f"{self.time_s:.2f} s, CPU {self.cpu_s:.2f} s"))
        rows.append(("Peak memory", number(self.peak_rss_mb, 0, " MB")))
        if self.ended:
            rows.append(("Ended", self.ended))
        return rows

    def _no_model_text(self) -> str:
        is_one_view = bool(self.frames_used)
        return "none: one keyframe sees it all" if is_one_view else "none: nothing could be placed"

    def _projection_text(self) -> str:
        if self.projection is None:
            return "-"
        if self.focal_px is None:
            return self.projection
        return f"{self.projection}, focal length {self.focal_px:.0f} px"

    def _canvas_text(self) -> str:
        if self.canvas_wh is None:
            return "none"
        text = f"{self.canvas_wh[0]}x{self.canvas_wh[1]} px"
        return text if self.scale == 1 else f"{text}, scale {self.scale:.3g}"

    def _evidence_rows(self) -> list[tuple[str, str]]:
        """Features, matches, inliers and RMSE: of the one link, or of all."""
        good = [link for link in self.links if link.verdict == "ok"]
        features = {image.index: image.features for image in self.images}
        threshold_px = self.settings.registration.inlier_threshold_px
        if len(self.links) == 1:
            return _link_rows(self.links[0], features, threshold_px)
        counts = list(features.values())
        rows = []
        if any(counts):  # a stream that is followed by grey values detects none
            rows.append(("Features", f"{min(counts)} to {max(counts)} a picture"))
        refused = Counter(link.verdict for link in self.links if link.verdict != "ok")
        text = f"{len(good)} accepted"
        if refused:
            text += "; refused: " + ", ".join(f"{why} {n}" for why, n in refused.most_common())
        rows.append(("Links", text))
        if good:
            if any(link.matches for link in good):
                rows.append(("Matches", _range_text([link.matches for link in good], " a link")))
            rows.append(("Inliers", _range_text([link.inliers for link in good], " a link")))
        return rows

    def _image_rows(self) -> list[tuple[str, str]]:
        skipped = sum(self.frames_skipped.values())
        rows = [("Pictures", f"{self.frames_used} used, {skipped} skipped")]
        named = [image for image in self.images if image.status is Status.SKIPPED]
        for image in named[:_LONG_LIST]:
            rows.append((f"Skipped {image.name}", image.reason))
        if not named:
            rows += [(f"Skipped: {why}", str(n)) for why, n in self.frames_skipped.items()]
        return rows

    def to_markdown(self) -> str:
        """The table as Markdown."""
        lines = markdown("Mosaic summary", self.rows())
        return "\n".join(lines) + "\n"

    def write_json(self, path: Path) -> None:
        """Write `to_json` as a whole file or not at all. Raises OutputError."""
        write_json(path, self.to_json())


def _link_rows(
    link: LinkSummary, features: dict[int, int], threshold_px: float
) -> list[tuple[str, str]]:
    share = f" ({link.inliers / link.pairs:.0%})" if link.pairs else ""
    rows = [
        ("Features", f"{features.get(link.a, 0)} and {features.get(link.b, 0)}"),
        ("Matches", str(link.matches)),
        ("Inliers", f"{link.inliers} of {link.pairs} pairs{share} within {threshold_px:g} px"),
        ("RMSE of the inliers", f"{number(link.rmse_px, 3, ' px')} (symmetric transfer)"),
    ]
    if link.verdict != "ok":
        rows.append(("Refused", link.verdict))
    if link.recall is not None and link.one_minus_precision is not None:
        rows.append(("Recall", f"{link.recall:.3f} (correct matches / correspondences)"))
        rows.append(("1 - precision", f"{link.one_minus_precision:.3f}"))
    if link.corner_error_px is not None:
        rows.append(("Corner error", f"{link.corner_error_px:.3f} px (mean of 4, against truth)"))
    return rows


def _more_row(key: str, value: Any) -> tuple[str, str]:
    label, unit = _MORE_LABELS.get(key, (key.replace("_", " ").capitalize(), ""))
    return label, "-" if value is None else f"{value}{unit}"


def _image_json(image: Placement) -> dict[str, Any]:
    matrix = image.world_from_picture
    return {
        "index": image.index,
        "name": image.name,
        "features": image.features,
        "status": image.status.value,
        "reason": image.reason,
        "time_s": known(image.time_s),
        "world_from_frame": None if matrix is None else np.asarray(matrix).tolist(),
    }


def _range_text(counts: list[int], unit: str) -> str:
    return f"{min(counts)} to {max(counts)}{unit}"
