"""Any block of a mosaic painted again from the views that are kept."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.mosaic import gains
from streamtrack.mosaic.stream import painting
from streamtrack.mosaic.stream.consensus import Chooser
from streamtrack.mosaic.stream.tiles import Box, common_box, is_empty
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

    def samples(self, views: Iterable[View], box: Box, chooser: Chooser) -> Iterator[None]:
        """Hand the views' pixels in ``box`` to the chooser, one at each step."""
        for view in views:
            if view.number not in self._store.views:
                continue  # dropped since the work began
            reach = painting.box_of(self.canvas_from_frame(view), view.size_wh)
            if not is_empty(common_box(reach, box)):
                chooser.add(self.warped(view, box), view.moment)
                yield

    def shrunk(self, view: View) -> tuple[Box, Image]:
        """All that a view shows, at a quarter of the size (BGRW), and where, in such pixels."""
        matrix = geometry.scaling(1 / painting.SHRINK) @ self.canvas_from_frame(view)
        box = painting.quarter(painting.box_of(self.canvas_from_frame(view), view.size_wh))
        small = painting.shrunk(self._pixels(view))
        return box, self._seen(view, small, matrix, box, cv2.INTER_LINEAR)

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
        part = common_box(painting.box_of(matrix, view.size_wh), box)
        result = np.zeros((box[3] - box[1], box[2] - box[0], 4), np.uint8)
        if is_empty(part):
            return result
        into = slice(part[1] - box[1], part[3] - box[1]), slice(part[0] - box[0], part[2] - box[0])
        result[into] = self._seen(view, pixels, matrix, part, self._flags)
        return result

    def _seen(
        self, view: View, pixels: Image, picture_from_frame: Matrix, box: Box, flags: int
    ) -> Image:
        """A view's pixels, of whatever size, in a box of the picture."""
        factor = pixels.shape[1] / view.size_wh[0], pixels.shape[0] / view.size_wh[1]
        matrix = picture_from_frame @ geometry.inverted(geometry.scaling(*factor))
        part = painting.warped(pixels, matrix, box, flags)
        if flags in (cv2.INTER_CUBIC, cv2.INTER_LANCZOS4):
            # Wide kernels ring at the frame's edge, where colours would fall to black.
            into_part = geometry.translation(-box[0], -box[1]) @ matrix
            size = part.shape[1], part.shape[0]
            kept = cv2.warpPerspective(
                pixels, into_part, size, flags=flags, borderMode=cv2.BORDER_REPLICATE
            )
            part[..., :3] = kept[..., :3]
        if view.doubts is not None:
            doubts_from_frame = gains.thumb_matrix(view.doubts, view.size_wh)
            from_doubts = picture_from_frame @ geometry.inverted(doubts_from_frame)
            part = painting.doubted(part, view.doubts, from_doubts, box)
        return painting.with_gain(part, view.log_gain)

    def _pixels(self, view: View) -> Image:
        pixels = self._decoded.get(view.number)
        if pixels is not None:
            self._decoded.move_to_end(view.number)
            return pixels
        image = self._store.image_of(view)
        pixels = painting.weighted(image, view.quads, min(1.0, self._scale))
        self.remember(view, pixels)
        return pixels
