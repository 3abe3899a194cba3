"""The background of a camera that stands: the median of pictures taken ever further apart."""

from __future__ import annotations

from collections import deque

import numpy as np

from streamtrack.types import Frame, Image
from streamtrack.working_size import reduced

_SIDE = 384
_SAMPLES = 9
_FIRST_GAP_S, _MAX_GAP_S = 0.5, 60.0


class BackgroundPicture:
    """Takes a look at some frames; what only passes by is in few of them."""

    def __init__(self) -> None:
        self._samples: deque[Image] = deque(maxlen=_SAMPLES)
        self._last_s = 0.0
        self._gap_s = 0.0

    def seen(self, frame: Frame) -> Image | None:
        """The background (h, w) or (h, w, 3), small, where the next frame changes what is known."""
        if 0.0 <= frame.time_s - self._last_s < self._gap_s:
            return None
        self._last_s = frame.time_s
        self._gap_s = min(max(_FIRST_GAP_S, 2 * self._gap_s), _MAX_GAP_S)
        small = reduced(frame.image, min(1.0, _SIDE / max(frame.size_wh)))
        if self._samples and self._samples[0].shape != small.shape:
            return None  # another camera's, for the world stays that of the first
        self._samples.append(small)
        middle = len(self._samples) // 2
        if len(self._samples) % 2 == 0 and len(self._samples) < _SAMPLES:
            return None  # of an even number there is no middle one
        return np.asarray(np.partition(np.stack(self._samples), middle, axis=0)[middle], np.uint8)
