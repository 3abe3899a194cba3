"""Things that touch: where they stand out as one, each is found by its own picture.

Their blobs then tell little, and flow there is mostly that of the larger one. A thing whose picture
is not found while it touches another, is hidden by that: it goes on as before for some frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.auto.anchor import Anchor, Held, align
from streamtrack.auto.blobs import Blob, Scene
from streamtrack.auto.boxes import box_around, overlap, overlaps, touched_edges
from streamtrack.auto.followed import Followed, Life
from streamtrack.auto.likeness import Likeness
from streamtrack.auto.places import Moment, motion_within
from streamtrack.pyramid import Pyramid

Doubles: TypeAlias = npt.NDArray[np.float64]

CARRYING_SHARE = 0.3  # of a thing's place that must stand out for it to be carried
_TOUCH_PX = 2.0  # grid pixels between boxes
_WHOLE = 0.85, 1.18  # size of what is found against its own, while it is seen whole
_CORE_SHARE = 0.75
_ELDER_HITS = 10  # sightings of its own that make it a thing of its own
_ALIKE_PX = 0.8  # grid pixels a frame, between motions of parts of one thing
_DUPLICATE_OVERLAP = 0.75
_SAME_OVERLAP = 0.6  # of boxes of which one is right
_MOST_JOINED = 25  # frames in a row in one blob, after which parts of it are parts of one thing
_BESIDE = 0.3  # of a thing's box in another's, less than which they lie side by side
_KNOWN_HITS = 12  # sightings after which its box is right
_PORTRAIT_FRAMES = 3  # between two pictures of a thing
_MOST_GUESSED = 10  # frames that a hidden thing goes on as before


def note_contacts(things: Sequence[Followed], moment: Moment) -> None:
    """Note which of the things, already predicted, touch another."""
    there = [thing for thing in things if thing.life in (Life.SEEN, Life.CARRIED)]
    for thing in things:
        thing.touches = False
    if len(there) < 2:
        return
    margin = _TOUCH_PX * moment.grid_px * np.array([-0.5, -0.5, 0.5, 0.5])
    boxes = np.stack([thing.box for thing in there]) + margin
    counts = np.count_nonzero(overlaps(boxes, boxes)[1], axis=1)  # itself among them
    for thing, count in zip(there, counts.tolist(), strict=True):
        thing.touches = count > 1


def align_all(
    things: Sequence[Followed],
    pyramid: Pyramid,
    turn: complex,
    moment: Moment,
) -> None:
    """Put the things whose own picture is found to where it is, to a part of a pixel.

    ``turn`` is what the camera's motion turns and enlarges.
    """
    there = []
    for thing in things:
        thing.is_aligned = False
        if thing.held is None:
            continue
        thing.held.turn *= turn
        if touched_edges(thing.box, moment.size_wh).any():
            thing.held = None  # its box is cut from now on
        elif thing.life in (Life.SEEN, Life.CARRIED):
            there.append((thing, thing.held))
    if not there:
        return
    centers = np.array([held.center_for(thing.center) for thing, held in there])
    turns = np.array([held.turn for _, held in there])
    found = align(pyramid, [held.anchor for _, held in there], centers, turns)
    for row, (thing, held) in enumerate(there):
        correlation = float(found.correlations[row]) if found.is_near[row] else 0.0
        if held.is_found(correlation):
            thing.align(complex(found.centers[row]), complex(found.turns[row]), moment.step_s)


def hold(thing: Followed, pyramid: Pyramid, scene: Scene, moment: Moment) -> None:
    """Take the exact picture of a thing that is seen alone and whole, if the last is no good."""
    held = thing.held
    if held is not None and not held.is_stale:
        return
    if thing.hits < _KNOWN_HITS or thing.touches:
        return
    if touched_edges(thing.box, moment.size_wh).any():
        return
    anchor = Anchor.taken(pyramid, thing.box, scene)
    if anchor is not None:
        thing.held = Held(anchor, thing.size)
        if held is not None:
            thing.held.looks = held.looks


def sight(thing: Followed, scene: Scene, moment: Moment) -> bool:
    """Move a thing to where its own picture is seen, if it is."""
    if thing.is_aligned:
        thing.guessed = thing.misses = 0
        return True
    if thing.likeness is None:
        return False
    beside = thing.likeness.find(scene.image, _core(thing, scene), thing.guessed)
    if beside is None:
        return False
    thing.carry(thing.velocity * moment.step_s + beside * moment.grid_px, moment.step_s)
    thing.guessed = 0
    return True


def carry(thing: Followed, scene: Scene, moment: Moment) -> bool:
    """Move a thing that was not sighted as the pixels in its place move; False if it is gone."""
    if thing.touches and thing.likeness is not None:
        thing.guessed += 1
        return thing.guessed <= _MOST_GUESSED
    found = motion_within(scene, thing.box)
    if found is None or found[1] < CARRYING_SHARE:
        return False
    thing.carry(found[0], moment.step_s)
    return True


def portray(thing: Followed, blob: Blob, scene: Scene) -> None:
    """Keep a picture of a thing that is seen alone and whole."""
    if thing.touches or thing.life is not Life.SEEN or not is_whole(thing, blob):
        return
    thing.alone += 1
    if thing.likeness is not None and thing.alone % _PORTRAIT_FRAMES:
        return
    taken = Likeness.taken(scene.image, _core(thing, scene))
    thing.likeness = taken or thing.likeness


def is_whole(thing: Followed, blob: Blob) -> bool:
    """Is what was found as large as the thing is?"""
    ratio = blob.size / np.maximum(thing.size, 1e-6)
    return bool((ratio > _WHOLE[0]).all() and (ratio < _WHOLE[1]).all())


def own_things(things: Sequence[Followed], moment: Moment) -> list[Followed]:
    """Of things that share a blob those that are no fragments of the others.

    Fragments were hardly ever seen alone, and move as the rest does.
    """
    for thing in things:
        thing.joined += 1
    elders = [thing for thing in things if _is_own(thing, things)]
    first = max(things, key=lambda thing: thing.hits)
    others = [
        thing for thing in things if thing not in elders and not is_alike(thing, first, moment)
    ]
    return [*(elders or [first]), *(thing for thing in others if thing is not first)]


def _is_own(thing: Followed, beside: Sequence[Followed]) -> bool:
    """Was it seen alone, or for long beside the others, hardly over them?"""
    if thing.alone >= _ELDER_HITS:
        return True
    return (
        thing.hits >= _ELDER_HITS
        and thing.joined < _MOST_JOINED
        and all(
            overlap(thing.box, other.box)[1] < _BESIDE for other in beside if other is not thing
        )
    )


def end_duplicates(things: Sequence[Followed], moment: Moment) -> None:
    """Of two things at one place, moving alike, the one that was seen for longer is right.

    Two that were each seen alone are two, unless the picture of only one of them is seen there.
    """
    named = [thing for thing in things if thing.life in (Life.SEEN, Life.CARRIED)]
    if len(named) < 2:
        return
    named.sort(key=lambda thing: -thing.hits)
    boxes = np.stack([thing.box for thing in named])
    common, inside = overlaps(boxes, boxes)
    for row, column in np.argwhere(np.tril(inside > _DUPLICATE_OVERLAP, -1)).tolist():
        younger, elder = named[row], named[column]
        if common[row, column] > _SAME_OVERLAP and younger.is_aligned != elder.is_aligned:
            mistaken = elder if younger.is_aligned else younger
            mistaken.life, mistaken.reason = Life.LOST, "another is seen in its place"
            continue
        if elder.life is Life.OVER or min(younger.alone, elder.alone) >= _ELDER_HITS:
            continue
        if common[row, column] > _DUPLICATE_OVERLAP or is_alike(elder, younger, moment):
            younger.life = Life.OVER


def is_alike(one: Followed, other: Followed, moment: Moment) -> bool:
    """Do two things move as parts of one would?"""
    apart = float(np.hypot(*(one.velocity - other.velocity))) * moment.step_s
    return apart <= _ALIKE_PX * moment.grid_px


def hold_to_edges(things: Sequence[Followed], blob: Blob) -> None:
    """Shift the outermost things of a shared blob so that they end where it ends."""
    for axis in (0, 1):
        first = min(things, key=lambda thing: float(thing.box[axis]))
        last = max(things, key=lambda thing: float(thing.box[axis + 2]))
        for thing, edge in ((first, axis), (last, axis + 2)):
            off = float(blob.box[edge] - thing.box[edge])
            if not thing.is_aligned and abs(off) <= 0.25 * float(thing.size[axis]):
                thing.box[[axis, axis + 2]] += 0.3 * off


def _core(thing: Followed, scene: Scene) -> Doubles:
    """The inner part of a thing's box, in the grid: what lies around it does not belong to it."""
    core = box_around(thing.center, _CORE_SHARE * thing.size).reshape(2, 2)
    return geometry.transform_points(scene.grid_from_frame, core).astype(np.float64).ravel()
