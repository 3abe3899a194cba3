"""Motion against the background: where pixels go, which of them move, and which surely rest.

Flow is smooth: it reaches out from what moves into the ground around, and over the gap between two
things. So a pixel rests all the same if the frame before shows it better where it is than where
flow says that it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.auto.background import Outstanding
from streamtrack.types import Image, Mask

Floats: TypeAlias = npt.NDArray[np.float32]

REST_PX = 0.4  # grid pixels a frame, below which something stands
_ALL_KNOWN_SHARE = 0.98
_LEAST_SIDE_PX = 24
_CHANGE_FACTOR = 4.0  # of the noise, by which a pixel differs from the frame before
_RESTS = 0.5  # grey levels, by which rest must explain a pixel better
_MOST_GAIN = 6.0  # grey levels, beyond which a pixel does not count for more
_SAME_FACTOR = 3.0  # of the noise, within which a place looks as it did
_LEAST_SAME = 4.0  # grey levels
_WINDOW = 5, 5


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Motion in one frame, in the background's grid.

    flow      float32 (h, w, 2), grid pixels since the frame before; None if it was not measured
    moving    bool (h, w), what is not at rest, or near such
    changing  bool (h, w), of those: what looks otherwise than in the frame before
    rests     bool (h, w), what flow has move, and which surely does not
    """

    flow: Floats | None
    moving: Mask
    changing: Mask
    rests: Mask


class MotionField:
    """Measures `Motion` from frame to frame by DIS flow (Kroeger et al. 2016)."""

    def __init__(self) -> None:
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
        self._flow.setFinestScale(1)
        self._places: Floats | None = None

    def measure(self, seen: Outstanding) -> Motion:
        """The motion since the frame before; none where nothing stands out."""
        before = seen.grey_before
        is_known = seen.known.mean() > _ALL_KNOWN_SHARE and not seen.clear.any()
        if before is None or min(before.shape) < _LEAST_SIDE_PX or is_known:
            nothing = np.zeros(seen.clear.shape, np.bool_)
            return Motion(None, nothing, nothing, nothing)
        backward = np.zeros((*before.shape, 2), np.float32)
        self._flow.calc(seen.grey, before, backward)
        x, y = cv2.split(backward)
        flows = (cv2.magnitude(x, y) > REST_PX) & seen.comparable
        change = np.asarray(cv2.absdiff(seen.grey, before), np.uint8)
        change[~seen.comparable] = 0
        noise = 1.4826 * float(np.median(change[::3, ::3]))
        marked = (change > _CHANGE_FACTOR * max(1.0, noise)).astype(np.uint8)
        changed = cv2.medianBlur(marked, 3)
        around = cv2.dilate(changed, np.ones((9, 9), np.uint8)) > 0
        within = cv2.morphologyEx(changed, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8)) > 0
        is_same = cv2.blur(change, _WINDOW) < max(_LEAST_SAME, _SAME_FACTOR * noise)
        rests = flows & is_same & (self._gain(seen.grey, before, change, backward) < -_RESTS)
        flows &= ~rests
        return Motion(-backward, flows & around, flows & within, rests)

    def _gain(self, grey: Image, before: Image, change: Image, backward: Floats) -> Floats:
        """By how many grey levels (h, w) the flow explains a place better than rest does."""
        if self._places is None or self._places.shape[:2] != grey.shape:
            height, width = grey.shape
            across, down = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
            self._places = np.dstack(np.meshgrid(across, down))
        x, y = cv2.split(self._places + backward)
        moved = cv2.remap(before, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        gain = cv2.subtract(change, cv2.absdiff(grey, moved), dtype=cv2.CV_32F)
        gain = np.clip(gain, -_MOST_GAIN, _MOST_GAIN)
        return np.asarray(cv2.blur(gain, _WINDOW), np.float32)
