"""One frame as the stages see it: each derived picture is made once, when first asked for."""

from __future__ import annotations

import time

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.features import FeatureExtractor
from streamtrack.types import Features, Frame, Image, Matrix, Size


class FrameView:
    """Grey pyramid and features of one frame, shared by all targets and the camera."""

    def __init__(self, frame: Frame, extractor: FeatureExtractor) -> None:
        self.frame = frame
        self._extractor = extractor
        self._levels = [geometry.grey_of(frame.image)]
        self._features: Features | None = None
        self.detect_ms = 0.0

    @property
    def grey(self) -> Image:
        """The frame in grey (H, W)."""
        return self._levels[0]

    @property
    def size_wh(self) -> Size:
        return self.grey.shape[1], self.grey.shape[0]

    def level(self, octave: int) -> Image:
        """The grey frame halved ``octave`` times; see `level_from_frame` for coordinates."""
        while len(self._levels) <= octave:
            finer = self._levels[-1]
            size = max(1, finer.shape[1] // 2), max(1, finer.shape[0] // 2)
            coarser = cv2.resize(finer, size, interpolation=cv2.INTER_AREA)
            self._levels.append(np.asarray(coarser, np.uint8))
        return self._levels[octave]

    def features(self) -> Features:
        """The frame's features, detected at the first call."""
        if self._features is None:
            start = time.perf_counter()
            self._features = self._extractor.extract(self.grey)
            self.detect_ms = (time.perf_counter() - start) * 1e3
        return self._features

    @property
    def detected(self) -> Features | None:
        """The features if any stage asked for them, else None."""
        return self._features


def level_from_frame(view: FrameView, octave: int) -> Matrix:
    """Matrix that takes frame pixels to pixels of ``view.level(octave)``."""
    width, height = view.size_wh
    level = view.level(octave)
    return geometry.scaling(level.shape[1] / width, level.shape[0] / height)
