"""One frame as the stages see it: each derived picture is made once, when first asked for."""

from __future__ import annotations

import time

from streamtrack import geometry
from streamtrack.budget import FULL_WORK, WorkLevel
from streamtrack.camera.view_levels import ViewLevels
from streamtrack.features import FeatureExtractor
from streamtrack.pyramid import Pyramid
from streamtrack.types import Features, Frame, Image, Size


class FrameView:
    """Grey pyramid and features of one frame, shared by all targets and the camera."""

    def __init__(
        self, frame: Frame, extractor: FeatureExtractor, work: WorkLevel = FULL_WORK
    ) -> None:
        self.frame = frame
        self.work = work
        self._extractor = extractor
        self.pyramid = Pyramid(geometry.grey_of(frame.image))
        self._levels: ViewLevels | None = None
        self._features: Features | None = None
        self._parts: dict[int | None, Features] = {}
        self.detect_ms = 0.0

    @property
    def grey(self) -> Image:
        """The frame in grey (H, W)."""
        return self.pyramid.grey

    @property
    def size_wh(self) -> Size:
        return self.pyramid.size_wh

    @property
    def levels(self) -> ViewLevels:
        """The levels at which the frame is aligned with other views."""
        if self._levels is None:
            self._levels = ViewLevels(self.grey)
        return self._levels

    def features(self) -> Features:
        """The frame's features, detected at the first call."""
        if self._features is None:
            start = time.perf_counter()
            self._features = self._extractor.extract(self.grey)
            self.detect_ms += (time.perf_counter() - start) * 1e3
        return self._features

    def part_of_features(self, part: int | None) -> Features:
        """A part of the frame's features, in turns of ``part``; all if they are known already.

        Part None is nearly all of them (`FeatureExtractor.extract_part`).
        """
        if self._features is not None:
            return self._features
        if part not in self._parts:
            start = time.perf_counter()
            self._parts[part] = self._extractor.extract_part(self.grey, part)
            self.detect_ms += (time.perf_counter() - start) * 1e3
        return self._parts[part]

    @property
    def detected(self) -> Features | None:
        """The features that any stage asked for, else None."""
        if self._features is not None or not self._parts:
            return self._features
        return max(self._parts.values(), key=len)
