"""Links between keyframes beyond the chain in which they were taken, and what follows from them.

Each new keyframe is compared with those that its predicted place overlaps. Whatever passes the
gate becomes an edge of the graph; then the poses around it are adjusted, and all poses if the
edge contradicts them (a loop was closed). The new poses are published at once.

The work is done where it arises (`LoopCloser.add`), so that a file gives the same poses at every
run, or by a thread of its own for live sources, which then never wait for it.
"""

from __future__ import annotations

import queue
import threading
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.keyframes import Keyframe, KeyframeGraph
from streamtrack.mosaic.adjustment import adjust
from streamtrack.mosaic.types import Link
from streamtrack.types import Matches, Matrix, Model, Registration, Size
from streamtrack.view_alignment import ViewAlignment, align, align_exactly
from streamtrack.view_levels import ReferenceView, ViewLevels

_MIN_LINK_OVERLAP = 0.25
_MAX_NEIGHBOURS = 1  # taken shortly before, beside the one that the keyframe was measured against
_MAX_LOOPS = 2
_RECENT = 8  # keyframes taken shortly before are neighbours, others are loops
_MAX_SURPRISE_PX = 1.0  # of an edge, beyond which all poses are adjusted
_GROWTH = 1.1  # factor between the sizes of a graph at two adjustments of all that no loop forces
_LEAST_GROWTH = 1.02  # and that one does
_WINDOW = 4  # keyframes whose poses a new edge may move at once
_LEVELS_KEPT = 24
_MAX_SAME_PLACE = 0.8  # overlap with the keyframe last compared, above which nothing new is seen


@dataclass(frozen=True, slots=True, eq=False)
class NewKeyframe:
    """A keyframe to be linked, with its views at hand."""

    index: int
    reference: ReferenceView
    chained_to: int | None


class LevelCache:
    """Views of the keyframes last used; others are decoded anew."""

    def __init__(self, graph: KeyframeGraph, count: int = _LEVELS_KEPT) -> None:
        self._graph = graph
        self._count = count
        self._levels: OrderedDict[int, ViewLevels] = OrderedDict()
        self._lock = threading.Lock()

    def add(self, index: int, levels: ViewLevels) -> None:
        with self._lock:
            self._levels[index] = levels
            self._levels.move_to_end(index)
            while len(self._levels) > self._count:
                self._levels.popitem(last=False)

    def get(self, index: int) -> ViewLevels:
        """The view of a keyframe."""
        with self._lock:
            levels = self._levels.get(index)
        if levels is None:
            levels = ViewLevels(self._graph.keyframes[index].picture.grey())
        self.add(index, levels)
        return levels


def link_of(view: int, reference: int, found: ViewAlignment) -> Link:
    """The graph's link from the keyframe ``view`` to the keyframe ``reference``.

    Its pairs lie on the alignment itself, one for each cell that agrees.
    """
    is_inlier = found.is_inlier
    a_points, b_points = found.view_points[is_inlier], found.reference_points[is_inlier]
    every, no_rows = np.ones(len(a_points), np.bool_), np.zeros(0, np.intp)
    registration = Registration(
        found.verdict, found.reference_from_view, Model.HOMOGRAPHY, every, found.rmse_px
    )
    return Link(
        view,
        reference,
        a_points,
        b_points,
        registration,
        Matches(no_rows, no_rows, np.zeros(0, np.float32)),
        found.rmse_px,
        found.correlation,
    )


def overlapping(
    graph: KeyframeGraph, world_from_view: Matrix, size_wh: Size, least: float
) -> list[tuple[float, int]]:
    """(share, index) of the keyframes that see at least a share of a view, the best first."""
    keyframes = list(graph.keyframes.values())
    quad = geometry.transform_points(world_from_view, geometry.image_quad(size_wh))
    if not keyframes or not np.isfinite(quad).all():
        return []
    near = _near(keyframes, quad.astype(np.float64))
    shares = []
    for keyframe in (keyframes[row] for row in near):
        share = _seen_share(world_from_view, size_wh, keyframe)
        if share >= least:
            shares.append((share, keyframe.index))
    return sorted(shares, key=lambda entry: (-entry[0], entry[1]))


def _seen_share(world_from_view: Matrix, size_wh: Size, keyframe: Keyframe) -> float:
    """Share of a view that a keyframe sees, as far as is known."""
    to_keyframe = geometry.inverted(keyframe.world_from_keyframe) @ world_from_view
    seen = geometry.transform_points(to_keyframe, geometry.image_quad(size_wh))
    if not np.isfinite(seen).all() or not geometry.is_convex(seen):
        return 0.0
    return geometry.visible_share(seen, keyframe.size_wh)


def _near(
    keyframes: list[Keyframe], quad: npt.NDArray[np.float64]
) -> npt.NDArray[np.signedinteger]:
    """Rows of the keyframes whose middles are no farther than two pictures can touch."""
    poses = np.stack([keyframe.world_from_keyframe for keyframe in keyframes])
    width, height = keyframes[0].size_wh
    middles = poses @ np.array([(width - 1) / 2, (height - 1) / 2, 1.0])
    centres = middles[:, :2] / middles[:, 2:]
    middle = quad.mean(axis=0)
    reach = float(np.max(np.linalg.norm(quad - middle, axis=1)))
    distances = np.linalg.norm(centres - middle, axis=1)
    rows = np.flatnonzero(distances < 2.5 * reach)
    return rows[np.argsort(distances[rows], kind="stable")][:64]


class LoopCloser:
    """Finds links for new keyframes and keeps the graph adjusted.

    ``is_threaded`` does it in a thread of its own, else every call returns when it is done.
    """

    def __init__(self, graph: KeyframeGraph, levels: LevelCache, is_threaded: bool) -> None:
        self._graph = graph
        self._levels = levels
        self._adjusted_at = 1
        self._compared: int | None = None
        self._failure: BaseException | None = None
        self._waiting: queue.Queue[NewKeyframe | None] | None = None
        self._thread: threading.Thread | None = None
        if is_threaded:
            self._waiting = queue.Queue()
            self._thread = threading.Thread(target=self._work, name="loops", daemon=True)
            self._thread.start()

    def add(self, keyframe: NewKeyframe) -> None:
        """Link a new keyframe that the graph already holds."""
        if self._waiting is None:
            self._link(keyframe)
        else:
            self._waiting.put(keyframe)

    def close(self) -> None:
        """Finish what is waiting, adjust all poses once more, and end the thread.

        Raises what went wrong in the thread, if anything did.
        """
        if self._waiting is not None and self._thread is not None:
            self._waiting.put(None)
            self._thread.join()
            self._waiting = self._thread = None
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure
        if len(self._graph.keyframes) > 2:
            self._adjust_all()

    def _work(self) -> None:
        assert self._waiting is not None
        while (keyframe := self._waiting.get()) is not None:
            try:
                self._link(keyframe)
            except BaseException as error:  # noqa: BLE001  it is raised again by `close`
                self._failure = error
                return

    # -- one keyframe --------------------------------------------------------------------------

    def _link(self, new: NewKeyframe) -> None:
        if self._compared is not None:
            here, before = (self._graph.keyframes[i] for i in (new.index, self._compared))
            if _seen_share(here.world_from_keyframe, here.size_wh, before) > _MAX_SAME_PLACE:
                return
        self._compared = new.index
        tried = [self._try(new, index) for index in self._candidates(new)]
        found = [joined for joined in tried if joined is not None]
        if not found:
            return
        growth = len(self._graph.keyframes) / self._adjusted_at
        is_surprise = any(loop and surprise > _MAX_SURPRISE_PX for surprise, loop in found)
        if growth >= _GROWTH + 4 / self._adjusted_at or (is_surprise and growth >= _LEAST_GROWTH):
            self._adjust_all()
        else:
            self._adjust_around()

    def _candidates(self, new: NewKeyframe) -> list[int]:
        """Keyframes to compare with: some taken shortly before, and the best of all others."""
        keyframes = self._graph.keyframes
        here = keyframes[new.index]
        shares = overlapping(self._graph, here.world_from_keyframe, here.size_wh, _MIN_LINK_OVERLAP)
        recent = set(list(keyframes)[-_RECENT:])
        known = {new.index, new.chained_to}
        neighbours = [i for _, i in shares if i in recent and i not in known]
        loops = [i for _, i in shares if i not in recent and i not in known]
        return neighbours[:_MAX_NEIGHBOURS] + loops[:_MAX_LOOPS]

    def _try(self, new: NewKeyframe, other: int) -> tuple[float, bool] | None:
        """Join two keyframes if they pass the gate.

        Returns how far off their poses were, in pixels, and whether that is a loop.
        """
        keyframes = self._graph.keyframes
        here, there = keyframes[new.index], keyframes[other]
        guess = geometry.inverted(here.world_from_keyframe) @ there.world_from_keyframe
        is_loop = other not in list(keyframes)[-_RECENT:]
        levels = self._levels.get(other)
        found = align(new.reference, levels, guess)
        if found.reference_from_view is None and is_loop:
            found = align(new.reference, levels, guess, is_searched=True)
        if found.reference_from_view is not None:
            found = align_exactly(new.reference, levels, found.reference_from_view)
        if found.reference_from_view is None:
            return None
        self._graph.add_link(link_of(other, new.index, found), is_loop)
        corners = found.view_points[found.is_inlier]
        expected = geometry.transform_points(guess, corners)
        measured = geometry.transform_points(found.reference_from_view, corners)
        off_px = float(np.sqrt(np.mean(np.sum((expected - measured) ** 2, axis=1))))
        return off_px, is_loop

    # -- adjustment ----------------------------------------------------------------------------

    def _adjust_all(self) -> None:
        graph = self._graph
        keyframes, links = graph.keyframes, graph.links
        sizes = {index: keyframe.size_wh for index, keyframe in keyframes.items()}
        poses = {index: keyframe.world_from_keyframe for index, keyframe in keyframes.items()}
        self._adjusted_at = len(keyframes)
        first = next(iter(keyframes))
        adjusted = adjust(poses, links, sizes, first, Model.HOMOGRAPHY, is_near=True)
        wrong = {(links[row].a, links[row].b) for row in adjusted.rejected}
        if wrong:
            graph.drop_links(wrong)
        graph.move(adjusted.world_from_picture)

    def _adjust_around(self) -> None:
        """Adjust the last keyframes to all that they hang on."""
        graph = self._graph
        keyframes, links = graph.keyframes, graph.links
        free = set(list(keyframes)[-_WINDOW:]) - {next(iter(keyframes))}
        near = [link for link in links if link.a in free or link.b in free]
        held = {end for link in near for end in (link.a, link.b)} - free
        if not held:
            return
        chosen = {i: keyframes[i].world_from_keyframe for i in sorted(free | held)}
        sizes = {i: keyframes[i].size_wh for i in chosen}
        adjusted = adjust(
            chosen, near, sizes, min(held), Model.HOMOGRAPHY, fixed=held, is_near=True
        )
        moved = {i: pose for i, pose in adjusted.world_from_picture.items() if i in free}
        graph.move(moved)
