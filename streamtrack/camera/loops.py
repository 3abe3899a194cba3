"""Loops are closed in the background, on the second core: the stream never waits for them long.

New keyframes are linked and adjusted by a thread (see `keyframe_links`), one job at a time, each
on a draft of its own. What a job found is taken over by the stream between two frames: from a
file a set number of frames after the job began, so that a file gives the same poses at every run;
from a live source as soon as it is done.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from math import isfinite

from streamtrack.camera import keyframe_links
from streamtrack.camera.keyframe_links import Draft, Joined, LevelCache, NewKeyframe
from streamtrack.camera.keyframes import KeyframeGraph
from streamtrack.camera.lens import agreed, is_news

_LINK_FRAMES = 4  # after which the result of linking a keyframe is taken over
_LINKS_A_FRAME = 8  # adjusting so many takes a frame more
_MOST_WAITING = 8
_MAX_SURPRISE_PX = 1.0  # of an edge, beyond which all poses are adjusted
_GROWTH = 1.1  # factor between the sizes of a graph at two adjustments of all that no loop forces
_LEAST_GROWTH = 1.02  # and that one does
_MOST_BENDS = 256
_MAX_SAME_PLACE = 0.8  # overlap with the keyframe last compared, above which nothing new is seen


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """Work in the thread on a draft; it returns whether all poses should be adjusted next."""

    draft: Draft
    wants_all: Future[bool]
    due_frame: int


class LoopCloser:
    """Finds links for new keyframes and keeps the graph adjusted.

    Used by one thread, which calls `advance` once a frame. ``is_live``: never wait for a job.
    """

    def __init__(self, graph: KeyframeGraph, is_live: bool) -> None:
        self._graph = graph
        self._is_live = is_live
        self._levels = LevelCache(graph)  # of its own: what is in it does not hang on timing
        self._waiting: deque[NewKeyframe] = deque()
        self._job: _Job | None = None
        self._wants_all = False
        self._frame = 0
        self._adjusted_at = 1
        self._compared: int | None = None
        self._thread: ThreadPoolExecutor | None = None
        self._bends: deque[float] = deque(maxlen=_MOST_BENDS)

    def add(self, keyframe: NewKeyframe) -> None:
        """Link a new keyframe that the graph already holds."""
        self._waiting.append(keyframe)
        if self._is_live and len(self._waiting) > _MOST_WAITING:
            self._waiting.popleft()  # it keeps the link by which it was taken

    def advance(self) -> None:
        """Take over what is due, and begin what waits. Raises what went wrong in the thread."""
        self._frame += 1
        if self._job is not None and self._is_due(self._job):
            self._take_over(self._job)
        if self._job is None:
            self._begin()

    def close(self) -> None:
        """Finish what is waiting, adjust all poses once more, and end the thread."""
        try:
            while self._job is not None or self._waiting or self._wants_all:
                if self._job is not None:
                    self._take_over(self._job)
                self._begin()
            if len(self._graph.keyframes) > 2:
                draft = Draft(self._graph)
                keyframe_links.adjust_all(draft)
                draft.publish(self._graph)
        finally:
            self._waiting.clear()
            if self._thread is not None:
                self._thread.shutdown()
                self._thread = None

    def _is_due(self, job: _Job) -> bool:
        if self._is_live:
            return job.wants_all.done()
        return self._frame >= job.due_frame or len(self._waiting) > _MOST_WAITING

    def _take_over(self, job: _Job) -> None:
        self._job = None
        self._wants_all = job.wants_all.result()
        job.draft.publish(self._graph)

    def _begin(self) -> None:
        """Start the next job: all poses, if the last one asked for that, or a keyframe."""
        if self._wants_all:
            self._wants_all = False
            self._adjusted_at = len(self._graph.keyframes)
            self._start(self._adjust_all, _LINK_FRAMES + len(self._graph.links) // _LINKS_A_FRAME)
        elif self._waiting:
            new = self._waiting.popleft()
            self._levels.add(new.index, new.reference.levels)
            self._start(lambda draft: self._link(draft, new), _LINK_FRAMES)

    def _start(self, work: Callable[[Draft], bool], frames: int) -> None:
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, "loops")
        draft = Draft(self._graph)
        self._job = _Job(draft, self._thread.submit(work, draft), self._frame + frames)

    # -- in the thread -------------------------------------------------------------------------

    def _link(self, draft: Draft, new: NewKeyframe) -> bool:
        keyframe_links.measure_exactly(draft, new, self._levels.get(new.chained_to))
        found = self._joined(draft, new)
        if found:
            keyframe_links.adjust_around(draft)
        growth = len(draft.keyframes) / self._adjusted_at
        is_surprise = any(one.is_loop and one.surprise_px > _MAX_SURPRISE_PX for one in found)
        self._bends.extend(bend for bend in draft.bends if isfinite(bend))
        lens = agreed(self._bends)
        if is_news(lens, draft.lens):
            draft.lens = lens
            return True
        is_grown = growth >= _GROWTH + 4 / self._adjusted_at
        return is_grown or (is_surprise and growth >= _LEAST_GROWTH)

    def _joined(self, draft: Draft, new: NewKeyframe) -> list[Joined]:
        before = self._compared
        if before is not None and keyframe_links.shows_the_same(
            draft, new.index, before, _MAX_SAME_PLACE
        ):
            return []
        self._compared = new.index
        return keyframe_links.join(draft, new, self._levels)

    def _adjust_all(self, draft: Draft) -> bool:
        keyframe_links.adjust_all(draft)
        return False
