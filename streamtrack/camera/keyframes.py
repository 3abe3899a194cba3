"""The keyframes of a moving camera: few pictures that stand for all, and how they hang together.

Every frame's pose is kept against one keyframe, so that when the keyframes move (a loop was
closed) all frames move with them. Keyframes are named by the index of their frame. Pictures are
kept as JPEG, in memory up to a limit and in a temporary file beyond it.

Readers in other threads see whole states: what `KeyframeGraph` hands out never changes later.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot
from types import MappingProxyType

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.camera.frame_poses import FramePose, FramePoses
from streamtrack.camera.lens import STRAIGHT
from streamtrack.errors import OutputError
from streamtrack.mosaic.spill import Slot, SpillFile
from streamtrack.mosaic.types import Link
from streamtrack.pose_graph import KeyframeEdge
from streamtrack.types import Image, Matrix, Points, Size

_JPEG_QUALITY = 92
_MAX_PICTURES_MB = 128.0
_VISIBLE_PX = 0.02
_LINK_SIGMA_PX = 0.05  # of one keyframe against the next


class PictureStore:
    """Encoded pictures: in memory up to ``max_mb``, the others in a temporary file."""

    def __init__(self, max_mb: float) -> None:
        self._max_bytes = int(max_mb * 2**20)
        self._bytes = 0
        self._file = SpillFile()

    def add(self, image: Image) -> StoredPicture:
        """The picture (BGR or grey) encoded and put away. Raises OutputError if the disk fails."""
        encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
        data = encoded.tobytes()
        if self._bytes + len(data) <= self._max_bytes:
            self._bytes += len(data)
            return StoredPicture(data, self._file, image.ndim == 3)
        return StoredPicture(self._file.put(data), self._file, image.ndim == 3)

    def close(self) -> None:
        """Give the temporary file back; pictures in it can no longer be read."""
        self._file.close()


@dataclass(frozen=True, slots=True, eq=False)
class StoredPicture:
    """One picture of a store: its bytes, or their place in the store's file."""

    data: bytes | Slot
    file: SpillFile
    is_color: bool

    def image(self) -> Image:
        """The picture decoded, (H, W, 3) BGR or (H, W) grey as it was given."""
        data = self.data if isinstance(self.data, bytes) else self.file.get(self.data)
        flag = cv2.IMREAD_COLOR if self.is_color else cv2.IMREAD_GRAYSCALE
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flag)
        if image is None:
            raise OutputError(
                "a keyframe's picture cannot be decoded: the temporary file is damaged"
            )
        return np.asarray(image, np.uint8)

    def grey(self) -> Image:
        """The picture decoded in grey (H, W)."""
        return geometry.grey_of(self.image())


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """One keyframe: the index and time of its frame, its picture and where it lies now.

    ``hidden`` are quads (4, 2) in it that do not belong to the scene.
    """

    index: int
    time_s: float
    size_wh: Size
    picture: StoredPicture
    world_from_keyframe: Matrix
    hidden: tuple[Points, ...] = ()

    def image(self) -> Image:
        """The picture, (H, W, 3) BGR or (H, W) grey, decoded anew at every call."""
        return self.picture.image()

    @property
    def centre(self) -> tuple[float, float]:
        """Where the middle of the picture lies in the world."""
        middle = [[(self.size_wh[0] - 1) / 2, (self.size_wh[1] - 1) / 2]]
        x, y = geometry.transform_points(self.world_from_keyframe, middle)[0]
        return float(x), float(y)


class KeyframeGraph:
    """Keyframes, the verified links between them, and every frame's pose against one of them.

    Poses map pixels that are straight by ``lens``; links hold them as they were seen.
    ``revision`` counts how often keyframes were moved. One thread adds, and asks for frames; any
    may read what there is of keyframes. Of more than ``most_frames`` (None: no limit) the oldest
    are forgotten, except those that are to be kept.
    """

    def __init__(
        self, max_pictures_mb: float = _MAX_PICTURES_MB, most_frames: int | None = None
    ) -> None:
        self._pictures = PictureStore(max_pictures_mb)
        self._lock = threading.Lock()
        self._keyframes: dict[int, Keyframe] = {}
        self._links: list[Link] = []
        self._edges: list[KeyframeEdge] = []
        self._frames = FramePoses(most_frames)
        self._revision = 0
        self._sigmas_px: dict[int, float] = {}
        self.lens = STRAIGHT

    @property
    def keyframes(self) -> Mapping[int, Keyframe]:
        """The keyframes by the index of their frame, in the order they were taken."""
        return MappingProxyType(self._keyframes)

    @property
    def edges(self) -> Sequence[KeyframeEdge]:
        """What hangs together."""
        with self._lock:
            return tuple(self._edges)

    @property
    def links(self) -> Sequence[Link]:
        """The evidence of the edges, one for one."""
        with self._lock:
            return tuple(self._links)

    @property
    def revision(self) -> int:
        return self._revision

    def poses(self) -> dict[int, Matrix]:
        """``world_from_keyframe`` of every keyframe, of one and the same revision."""
        return {index: keyframe.world_from_keyframe for index, keyframe in self._keyframes.items()}

    def world_from_frame(self, index: int) -> Matrix | None:
        """Where a frame lies by what is known now; None if it was refused, or is forgotten."""
        frame = self.frame_pose(index)
        if frame is None:
            return None
        world_from_keyframe = self._keyframes[frame.keyframe].world_from_keyframe
        return geometry.normalized(world_from_keyframe @ frame.keyframe_from_frame)

    def keyframe_of(self, index: int) -> int | None:
        """The keyframe that a frame moves with: itself, or the one it was measured against."""
        frame = self.frame_pose(index)
        return None if frame is None else frame.keyframe

    def sigma_px(self, index: int) -> float:
        """Expected RMS error of a frame's corners in the world, in pixels of the first frame.

        That of its keyframe at the last adjustment of all. Those taken since then are told of by
        their number: the errors of a chain grow about as the square of its length. NaN for a frame
        that is not known.
        """
        keyframe = self.keyframe_of(index)
        if keyframe is None:
            return float("nan")
        own = 0.0 if index in self._keyframes else _LINK_SIGMA_PX
        return hypot(self._keyframe_sigma_px(keyframe), own)

    def _keyframe_sigma_px(self, keyframe: int) -> float:
        sigmas, since = self._sigmas_px, 0
        for other in reversed(self._keyframes):
            if other in sigmas:
                break
            since += other <= keyframe
        if keyframe in sigmas:
            return sigmas[keyframe]
        last, known = next(reversed(sigmas.values())), len(sigmas)
        return last * (1 + since / known) ** 2 + _LINK_SIGMA_PX * since

    def expect(self, sigmas_px: Mapping[int, float]) -> None:
        """Say what errors are expected of keyframes, in the order they were taken."""
        self._sigmas_px = dict(sigmas_px)

    def frame_pose(self, index: int) -> FramePose | None:
        """The frame's own measurement: against which keyframe, and where in it."""
        if index in self._keyframes:
            return FramePose(index, np.eye(3))
        return self._frames.get(index)

    def keep(self, index: int) -> None:
        """Never forget where this frame lies."""
        self._frames.keep(index)

    def add_keyframe(
        self,
        index: int,
        time_s: float,
        image: Image,
        world_from_keyframe: Matrix,
        hidden: Sequence[Points] = (),
    ) -> Keyframe:
        """Take a frame as a keyframe; ``image`` is BGR or grey."""
        picture = self._pictures.add(image)
        size_wh = (image.shape[1], image.shape[0])
        outlines = tuple(hidden)
        keyframe = Keyframe(index, time_s, size_wh, picture, world_from_keyframe, outlines)
        if not self._keyframes:
            self._sigmas_px = {index: 0.0}
        with self._lock:
            # Readers may be going through the old dict: it is replaced, not changed.
            self._keyframes = {**self._keyframes, index: keyframe}
        return keyframe

    def add_frame(self, index: int, keyframe: int, keyframe_from_frame: Matrix) -> None:
        """Remember where a frame lies against a keyframe."""
        self._frames.add(index, FramePose(keyframe, keyframe_from_frame))

    def hide(self, index: int, hidden: tuple[Points, ...]) -> None:
        """Say what of a keyframe does not belong to the scene."""
        with self._lock:
            keyframe = replace(self._keyframes[index], hidden=hidden)
            self._keyframes = {**self._keyframes, index: keyframe}

    def add_link(self, link: Link, is_loop: bool) -> None:
        """Join two keyframes. The link's ``a`` and ``b`` are indices of keyframes."""
        edge = KeyframeEdge(link.a, link.b, link.registration.inliers, link.rmse_px, is_loop)
        with self._lock:
            self._links.append(link)
            self._edges.append(edge)

    def drop_links(self, wrong: Collection[tuple[int, int]]) -> None:
        """Take back the links (a, b) that turned out to be wrong."""
        with self._lock:
            kept = [row for row, link in enumerate(self._links) if (link.a, link.b) not in wrong]
            self._links = [self._links[row] for row in kept]
            self._edges = [self._edges[row] for row in kept]

    def move(self, world_from_keyframe: Mapping[int, Matrix]) -> None:
        """Give keyframes new poses, all at once, and count a revision if any moves visibly.

        Keyframes that were taken after the last of these are carried along with it.
        """
        with self._lock:
            poses = dict(world_from_keyframe)
            order = list(self._keyframes)
            places = [place for place, index in enumerate(order) if index in poses]
            if not places:
                return
            last = self._keyframes[order[places[-1]]]
            change = poses[last.index] @ geometry.inverted(last.world_from_keyframe)
            for index in order[places[-1] + 1 :]:
                carried = change @ self._keyframes[index].world_from_keyframe
                poses[index] = geometry.normalized(carried)
            if max(_moved_px(self._keyframes[i], pose) for i, pose in poses.items()) < _VISIBLE_PX:
                return
            moved = dict(self._keyframes)
            for index, pose in poses.items():
                moved[index] = replace(moved[index], world_from_keyframe=pose)
            self._keyframes = moved
            self._revision += 1

    def close(self) -> None:
        """Give the temporary file back."""
        self._pictures.close()


def _moved_px(keyframe: Keyframe, world_from_keyframe: Matrix) -> float:
    """How far a new pose moves the corner that it moves most, in world pixels."""
    corners = geometry.image_quad(keyframe.size_wh)
    before = geometry.transform_points(keyframe.world_from_keyframe, corners)
    after = geometry.transform_points(world_from_keyframe, corners)
    return float(np.max(np.abs(after - before)))
