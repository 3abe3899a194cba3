"""Links between keyframes beyond the chain in which they were taken, and what follows from them.

Each new keyframe is compared with those that its predicted place overlaps. Whatever passes the
gate becomes an edge of the graph; then the poses around it are adjusted, and all poses if the
edge contradicts them (a loop was closed).

All of it is done on a `Draft`, a copy of the graph that changes nothing until it is published: so
another thread may work on it while the graph grows (see `loops`).
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.camera.keyframes import Keyframe, KeyframeGraph
from streamtrack.camera.lens import seen_bend
from streamtrack.camera.view_alignment import align, align_exactly
from streamtrack.camera.view_levels import ReferenceView, ViewLevels
from streamtrack.camera.view_verdict import ViewAlignment
from streamtrack.mosaic.adjustment import adjust
from streamtrack.mosaic.types import Link
from streamtrack.types import Matches, Matrix, Model, Registration, Size

_MIN_LINK_OVERLAP = 0.25
_MAX_NEIGHBOURS = 2  # taken shortly before, beside the one that the keyframe was measured against
_MAX_LOOPS = 2
_RECENT = 8  # keyframes taken shortly before are neighbours, others are loops
_WINDOW = 4  # keyframes whose poses a new edge may move at once
_LEVELS_KEPT = 24
_NOISE_SHARE = 0.6
"""Of the shifts that a link's cells would still like to make, the noise of its pairs: measured on
flights with known poses, so that errors are about as large as expected."""


@dataclass(frozen=True, slots=True, eq=False)
class NewKeyframe:
    """A keyframe to be linked, with its view at hand.

    ``found`` is how it lies in the keyframe ``chained_to`` if that was measured with little care
    and is to be measured exactly; None if it is exact already.
    """

    index: int
    reference: ReferenceView
    chained_to: int
    found: ViewAlignment | None


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
    keyframes: Mapping[int, Keyframe], world_from_view: Matrix, size_wh: Size, least: float
) -> list[tuple[float, int]]:
    """(share, index) of the keyframes that see at least a share of a view, the best first."""
    every = list(keyframes.values())
    quad = geometry.transform_points(world_from_view, geometry.image_quad(size_wh))
    if not every or not np.isfinite(quad).all():
        return []
    near = _near(every, quad.astype(np.float64))
    shares = []
    for keyframe in (every[row] for row in near):
        share = seen_share(world_from_view, size_wh, keyframe)
        if share >= least:
            shares.append((share, keyframe.index))
    return sorted(shares, key=lambda entry: (-entry[0], entry[1]))


def seen_share(world_from_view: Matrix, size_wh: Size, keyframe: Keyframe) -> float:
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


class Draft:
    """The graph as it is now, to be worked on, and what was changed in it."""

    def __init__(self, graph: KeyframeGraph) -> None:
        self.keyframes: dict[int, Keyframe] = dict(graph.keyframes)
        self.links: list[Link] = list(graph.links)
        self._added: list[tuple[Link, bool]] = []
        self._dropped: set[tuple[int, int]] = set()
        self._moved: dict[int, Matrix] = {}
        self._sigmas_px: Mapping[int, float] | None = None
        self.lens = graph.lens
        self.bends: list[float] = []

    def add(self, link: Link, is_loop: bool) -> None:
        """Join two keyframes."""
        self.links.append(link)
        self._added.append((link, is_loop))

    def drop(self, wrong: Collection[tuple[int, int]]) -> None:
        """Take back links (a, b)."""
        self.links = [link for link in self.links if (link.a, link.b) not in wrong]
        self._added = [new for new in self._added if (new[0].a, new[0].b) not in wrong]
        self._dropped.update(wrong)

    def move(self, world_from_keyframe: Mapping[int, Matrix]) -> None:
        """Give keyframes new poses."""
        for index, pose in world_from_keyframe.items():
            self.keyframes[index] = replace(self.keyframes[index], world_from_keyframe=pose)
        self._moved.update(world_from_keyframe)

    def expect(self, sigmas_px: Mapping[int, float]) -> None:
        """Say how far off keyframes may be."""
        self._sigmas_px = sigmas_px

    def publish(self, graph: KeyframeGraph) -> None:
        """Make the changes in the graph, which may have grown since."""
        if self._dropped:
            graph.drop_links(self._dropped)
        for link, is_loop in self._added:
            graph.add_link(link, is_loop)
        if self._moved:
            graph.move(self._moved)
        graph.lens = self.lens
        if self._sigmas_px is not None:
            graph.expect(self._sigmas_px)


def measure_exactly(draft: Draft, new: NewKeyframe, levels: ViewLevels) -> None:
    """Replace the link by which a keyframe was taken by an exact one, if there is one.

    ``levels`` is the view of the keyframe that it was measured against.
    """
    if new.found is None or new.found.reference_from_view is None:
        return
    guess = geometry.inverted(new.found.reference_from_view)
    hidden = draft.keyframes[new.chained_to].hidden
    exact = align_exactly(new.reference, levels, guess, hidden)
    if exact.reference_from_view is None:
        return
    draft.drop({(new.index, new.chained_to)})
    draft.add(link_of(new.chained_to, new.index, exact), is_loop=False)
    size_wh = draft.keyframes[new.index].size_wh
    draft.bends.append(seen_bend(exact, size_wh))
    world_from_before = draft.keyframes[new.chained_to].world_from_keyframe
    pose = world_from_before @ geometry.inverted(draft.lens.flat(exact, size_wh))
    draft.move({new.index: geometry.normalized(pose)})


@dataclass(frozen=True, slots=True)
class Joined:
    """A new link: how far off the poses of its keyframes were, and whether it closes a loop."""

    surprise_px: float
    is_loop: bool


def join(draft: Draft, new: NewKeyframe, cache: LevelCache) -> list[Joined]:
    """Link a new keyframe with all others that it shows, as far as the gate lets them pass."""
    tried = [_try(draft, new, index, cache) for index in _candidates(draft, new)]
    return [joined for joined in tried if joined is not None]


def shows_the_same(draft: Draft, one: int, other: int, share: float) -> bool:
    """Whether two keyframes overlap by more than a share."""
    here, there = draft.keyframes[one], draft.keyframes[other]
    return seen_share(here.world_from_keyframe, here.size_wh, there) > share


def _candidates(draft: Draft, new: NewKeyframe) -> list[int]:
    """Keyframes to compare with: some taken shortly before, and the best of all others."""
    here = draft.keyframes[new.index]
    shares = overlapping(draft.keyframes, here.world_from_keyframe, here.size_wh, _MIN_LINK_OVERLAP)
    recent = _recent(draft)
    known = {new.index, new.chained_to}
    neighbours = [i for _, i in shares if i in recent and i not in known]
    loops = [i for _, i in shares if i not in recent and i not in known]
    return neighbours[:_MAX_NEIGHBOURS] + loops[:_MAX_LOOPS]


def _recent(draft: Draft) -> set[int]:
    return set(list(draft.keyframes)[-_RECENT:])


def _try(draft: Draft, new: NewKeyframe, other: int, cache: LevelCache) -> Joined | None:
    """Join two keyframes if they pass the gate."""
    here, there = draft.keyframes[new.index], draft.keyframes[other]
    guess = geometry.inverted(here.world_from_keyframe) @ there.world_from_keyframe
    is_loop = other not in _recent(draft)
    levels, hidden = cache.get(other), there.hidden
    found = align(new.reference, levels, guess, hidden)
    if found.reference_from_view is None and is_loop:
        found = align(new.reference, levels, guess, hidden, is_searched=True)
    if found.reference_from_view is not None:
        found = align_exactly(new.reference, levels, found.reference_from_view, hidden)
    if found.reference_from_view is None:
        return None
    draft.add(link_of(other, new.index, found), is_loop)
    draft.bends.append(seen_bend(found, here.size_wh))
    corners = found.view_points[found.is_inlier]
    expected = geometry.transform_points(guess, corners)
    measured = geometry.transform_points(draft.lens.flat(found, here.size_wh), corners)
    off_px = float(np.sqrt(np.mean(np.sum((expected - measured) ** 2, axis=1))))
    return Joined(off_px, is_loop)


def adjust_all(draft: Draft) -> None:
    """Adjust all poses to all links, and drop links that disagree with the others.

    What errors are expected of the poses is told, too.
    """
    keyframes = draft.keyframes
    links = [draft.lens.link(link, keyframes[link.a].size_wh) for link in draft.links]
    sizes = {index: keyframe.size_wh for index, keyframe in keyframes.items()}
    poses = {index: keyframe.world_from_keyframe for index, keyframe in keyframes.items()}
    first = next(iter(keyframes))
    adjusted = adjust(poses, links, sizes, first, Model.HOMOGRAPHY, is_near=True)
    draft.drop({(links[row].a, links[row].b) for row in adjusted.rejected})
    draft.move(adjusted.world_from_picture)
    rmse_px = [link.rmse_px for link in links if np.isfinite(link.rmse_px)]
    if rmse_px:
        noise_px = _NOISE_SHARE * float(np.sqrt(np.mean(np.square(rmse_px))))
        expected_px = adjusted.expected_errors_px(noise_px)
        if expected_px:  # else all links were dropped
            draft.expect(expected_px)


def adjust_around(draft: Draft) -> None:
    """Adjust the last keyframes to all that they hang on."""
    keyframes = draft.keyframes
    free = set(list(keyframes)[-_WINDOW:]) - {next(iter(keyframes))}
    near = [
        draft.lens.link(link, keyframes[link.a].size_wh)
        for link in draft.links
        if link.a in free or link.b in free
    ]
    held = {end for link in near for end in (link.a, link.b)} - free
    if not held:
        return
    chosen = {i: keyframes[i].world_from_keyframe for i in sorted(free | held)}
    sizes = {i: keyframes[i].size_wh for i in chosen}
    adjusted = adjust(chosen, near, sizes, min(held), Model.HOMOGRAPHY, fixed=held, is_near=True)
    draft.move({i: pose for i, pose in adjusted.world_from_picture.items() if i in free})
