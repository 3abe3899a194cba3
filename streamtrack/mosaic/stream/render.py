"""Any block of a mosaic painted again from the views that are kept."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Container, Iterable, Iterator

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.mosaic import gains
from streamtrack.mosaic.stream import painting
from streamtrack.mosaic.stream.consensus import Chooser
from streamtrack.mosaic.stream.tiles import Box, common_box
from streamtrack.mosaic.stream.views import View, ViewStore
from streamtrack.settings import Warping
from streamtrack.types import Image, Matrix

_LEAST_CACHED = 4
_FLAGS: dict[str, int] = {
    "nearest": cv2.INTER_NEAREST,
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}


class Renderer:
    """Warps views into blocks of a picture with ``scale`` pixels per world pixel.

    Decoded views stay in memory up to ``max_bytes`` (but never fewer than four).
    """

    def __init__(
        self, store: ViewStore, scale: float, max_bytes: int, warping: Warping = "linear"
    ) -> None:
        self._store = store
        self._scale = scale
        self._max_bytes = max_bytes
        self._flags = _FLAGS[warping]
        self._decoded: OrderedDict[int, Image] = OrderedDict()
        self._bytes = 0

    def canvas_from_frame(self, view: View) -> Matrix:
        """Where a view lies in the picture that is rendered."""
        return geometry.scaling(self._scale) @ view.world_from_frame

    def samples(
        self,
        views: Iterable[View],
        box: Box,
        chooser: Chooser,
        primary: Container[int] | None = None,
    ) -> Iterator[None]:
        """Hand the views' pixels in ``box`` to the chooser, one at each step.

        ``primary`` has the numbers of the views that come before the others; None: all are equal.
        """
        for view in views:
            if view.number not in self._store.views:
                continue  # dropped since the work began
            reach = painting.box_of(self.canvas_from_frame(view), view.size_wh)
            x0, y0, x1, y1 = reach
            if x0 < box[2] and x1 > box[0] and y0 < box[3] and y1 > box[1]:
                is_primary = primary is None or view.number in primary
                chooser.add(self.warped(view, box), is_primary, view.moment)
                yield

    def remember(self, view: View, pixels: Image) -> None:
        """Keep a view's pixels, `painting.weighted` at min(1, scale), as if it were decoded."""
        self._decoded[view.number] = pixels
        self._bytes += pixels.nbytes
        while self._bytes > self._max_bytes and len(self._decoded) > _LEAST_CACHED:
            self._bytes -= self._decoded.popitem(last=False)[1].nbytes

    def forget(self, view: View) -> None:
        """Let go of a view that was dropped."""
        pixels = self._decoded.pop(view.number, None)
        if pixels is not None:
            self._bytes -= pixels.nbytes

    def warped(self, view: View, box: Box) -> Image:
        """A view in a box of the picture (H, W, 4); only the part that it reaches is warped."""
        pixels, matrix = self._pixels(view), self.canvas_from_frame(view)
        x0, y0, x1, y1 = common_box(painting.box_of(matrix, view.size_wh), box)
        result = np.zeros((box[3] - box[1], box[2] - box[0], 4), np.uint8)
        if x0 >= x1 or y0 >= y1:
            return result
        factor = pixels.shape[1] / view.size_wh[0], pixels.shape[0] / view.size_wh[1]
        matrix = matrix @ geometry.inverted(geometry.scaling(*factor))
        part = painting.warped(pixels, matrix, (x0, y0, x1, y1), self._flags)
        if self._flags in (cv2.INTER_CUBIC, cv2.INTER_LANCZOS4):
            # Wide kernels ring at the frame's edge, where colours would fall to black.
            into_part = geometry.translation(-x0, -y0) @ matrix
            size = part.shape[1], part.shape[0]
            kept = cv2.warpPerspective(
                pixels, into_part, size, flags=self._flags, borderMode=cv2.BORDER_REPLICATE
            )
            part[..., :3] = kept[..., :3]
        into = slice(y0 - box[1], y1 - box[1]), slice(x0 - box[0], x1 - box[0])
        if view.doubts is not None:
            doubts_from_frame = gains.thumb_matrix(view.doubts, view.size_wh)
            from_doubts = self.canvas_from_frame(view) @ geometry.inverted(doubts_from_frame)
            part = painting.doubted(part, view.doubts, from_doubts, (x0, y0, x1, y1))
        result[into] = painting.with_gain(part, view.log_gain)
        return result

    def _pixels(self, view: View) -> Image:
        pixels = self._decoded.get(view.number)
        if pixels is not None:
            self._decoded.move_to_end(view.number)
            return pixels
        image = self._store.image_of(view)
        pixels = painting.weighted(image, view.quads, min(1.0, self._scale))
        self.remember(view, pixels)
        return pixels
