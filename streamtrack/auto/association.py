"""Which blob is which thing: fragments are put together, blobs of several things are told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack.auto.assignment import assign
from streamtrack.auto.blobs import Blob, united_blob
from streamtrack.auto.boxes import overlap, overlaps
from streamtrack.auto.followed import Followed, Life

Doubles: TypeAlias = npt.NDArray[np.float64]

_MAX_COST = 1.7
_GATE = 0.3  # of the extents of both, that a thing may lie off
_KNOWN_GATE = 0.18  # of what was seen in the frame before
_FRAGMENT_INSIDE = 0.7  # of a fragment's area that lies in the predicted box
_FRAGMENT_SHARE = 0.4  # of the largest of them
_PARTS_APART = 0.2  # of the reach, between the motions of fragments of one thing
_SHARED_INSIDE = 0.55  # of a predicted box that lies in a blob it shares
_SHARED_LARGER = 1.3  # how much larger than each of its things a shared blob is
_MAX_COLOR_DISTANCE = 0.55


@dataclass(frozen=True, slots=True, eq=False)
class Associated:
    """Which thing was found as which blob.

    ``shared`` are blobs that show several things; ``free`` are those that nothing claims.
    """

    pairs: tuple[tuple[Followed, Blob], ...]
    shared: tuple[tuple[tuple[Followed, ...], Blob], ...]
    free: tuple[Blob, ...]


def associate(things: Sequence[Followed], blobs: Sequence[Blob], reach_px: float) -> Associated:
    """Pair things, already predicted, with blobs; ``reach_px`` is added to every gate."""
    wholes = _put_together(things, blobs, reach_px)
    found = dict(assign(_costs(things, wholes, reach_px)))
    shared = _sharing(things, wholes, found)
    told = {row for rows in shared.values() for row in rows}
    taken = set(found.values())
    return Associated(
        tuple((things[row], wholes[column]) for row, column in found.items() if row not in told),
        tuple((tuple(things[r] for r in rows), wholes[c]) for c, rows in shared.items()),
        tuple(blob for column, blob in enumerate(wholes) if column not in taken),
    )


def found_again(thing: Followed, others: Sequence[Followed], reach_px: float) -> Followed | None:
    """The lost thing that a new one is: of its colours, where it may be by now, moving alike."""
    nearest, least = None, np.inf
    for lost in others:
        if lost.life is not Life.LOST:
            continue
        speed = float(np.hypot(*lost.velocity))
        extents = float(np.hypot(*thing.size) + np.hypot(*lost.size))
        gate_px = _GATE * extents + reach_px + 0.5 * lost.lost_s * speed
        off_px = float(np.hypot(*(thing.center - lost.center)))
        color = np.sqrt(max(0.0, 1.0 - float(np.sqrt(thing.colors * lost.colors).sum())))
        apart = float(np.hypot(*(thing.velocity - lost.velocity)))
        is_alike = color < _MAX_COLOR_DISTANCE and apart < 0.5 * (speed + reach_px)
        if is_alike and off_px < min(gate_px, least):
            nearest, least = lost, off_px
    return nearest


def _costs(things: Sequence[Followed], blobs: Sequence[Blob], reach_px: float) -> Doubles:
    """How unlike each thing where it should be is each blob (N, M); infinite beyond the gate."""
    if not things or not blobs:
        return np.zeros((len(things), len(blobs)))
    thing_boxes = np.stack([thing.box for thing in things])
    blob_boxes = np.stack([blob.box for blob in blobs])
    thing_sizes, blob_sizes = (b[:, 2:] - b[:, :2] for b in (thing_boxes, blob_boxes))
    middles = 0.5 * (thing_boxes[:, None, :2] + thing_boxes[:, None, 2:])
    off = np.linalg.norm(middles - 0.5 * (blob_boxes[:, :2] + blob_boxes[:, 2:]), axis=2)
    extents = np.linalg.norm(thing_sizes, axis=1)[:, None] + np.linalg.norm(blob_sizes, axis=1)
    is_lost = np.array([thing.life is Life.LOST for thing in things])[:, None]
    is_new = np.array([thing.life is Life.NEW for thing in things])[:, None]
    drift = np.array([0.5 * t.lost_s * float(np.hypot(*t.velocity)) for t in things])[:, None]
    is_known = ~(is_lost | is_new)
    gate_px = np.where(is_known, _KNOWN_GATE, _GATE) * extents
    gate_px += reach_px + np.where(is_lost, drift, 0.0)
    shared = (
        np.sqrt(np.stack([thing.colors for thing in things]))
        @ np.sqrt(np.stack([blob.colors for blob in blobs])).T
    )
    color = np.sqrt(np.maximum(0.0, 1.0 - shared))  # Hellinger distance
    ious, _ = overlaps(thing_boxes, blob_boxes)
    insides = overlaps(blob_boxes, thing_boxes)[1].T
    is_part = insides >= _FRAGMENT_INSIDE  # of something that is partly hidden
    ious = np.where(is_part, np.maximum(ious, 0.3), ious)
    late = np.where(is_lost, 0.5, np.where(is_new, 0.25, 0.0))
    costs = (1 - ious) + 0.5 * off / gate_px + 0.3 * color + late
    ratio = np.prod(blob_sizes, axis=1) / np.prod(thing_sizes, axis=1)[:, None]
    is_other = (color > _MAX_COLOR_DISTANCE) | (ratio > 3)
    is_other |= (ratio < 1 / 3) & (insides < _FRAGMENT_INSIDE)
    is_beyond = (off > gate_px) & (ious < 0.1)
    is_beyond |= (is_lost & is_other) | (costs - late > _MAX_COST)
    return np.where(is_beyond, np.inf, costs)


def _put_together(things: Sequence[Followed], blobs: Sequence[Blob], reach_px: float) -> list[Blob]:
    """The blobs, those that are fragments of one thing made one."""
    if not things or not blobs:
        return list(blobs)
    thing_boxes = np.stack([thing.box for thing in things])
    blob_boxes = np.stack([blob.box for blob in blobs])
    reach = 0.1 * (thing_boxes[:, 2:] - thing_boxes[:, :2])
    around = thing_boxes + np.concatenate([-reach, reach], axis=1)
    inside = overlaps(blob_boxes, around)[1].T  # share of each blob in each thing's surroundings
    ious = overlaps(thing_boxes, blob_boxes)[0]
    areas = np.prod(blob_boxes[:, 2:] - blob_boxes[:, :2], axis=1)
    united: dict[int, Blob] = {}
    gone: set[int] = set()
    order = np.argsort(-np.prod(thing_boxes[:, 2:] - thing_boxes[:, :2], axis=1), kind="stable")
    for row in order.tolist():
        if things[row].life in (Life.NEW, Life.LOST):
            continue
        is_other_whole = (np.delete(ious, row, axis=0) > 0.5).any(axis=0)
        parts = np.flatnonzero((inside[row] >= _FRAGMENT_INSIDE) & ~is_other_whole).tolist()
        parts = [part for part in parts if part not in gone]
        sizes = sorted(areas[parts])
        if len(parts) < 2:
            continue
        largest = blobs[max(parts, key=lambda part: float(areas[part]))]
        if sizes[-2] > _FRAGMENT_SHARE * sizes[-1] and not all(
            _is_in_line(blobs[part], largest, things[row].velocity) for part in parts
        ):
            continue  # two that are alike in size are two things, if nothing parts them
        parts = [part for part in parts if not _moves_otherwise(blobs[part], largest, reach_px)]
        if len(parts) < 2:
            continue
        whole = united_blob([blobs[part] for part in parts])
        if overlap(whole.box, things[row].box)[0] > ious[row, parts].max():
            united[parts[0]] = whole
            gone.update(parts)
    kept = [blob for column, blob in enumerate(blobs) if column not in gone]
    return kept + list(united.values())


def _is_in_line(blob: Blob, larger: Blob, velocity: Doubles) -> bool:
    """Do two lie behind one another in the way they go, as what shows on both sides of a post?"""
    across = int(np.argmin(np.abs(velocity)))
    low = max(blob.box[across], larger.box[across])
    high = min(blob.box[across + 2], larger.box[across + 2])
    return bool(high - low > 0.5 * float(larger.size[across]))


def _moves_otherwise(blob: Blob, larger: Blob, reach_px: float) -> bool:
    """Never so if a motion is not known; beside what hides a thing flow sees it slower."""
    apart, speed = np.hypot(*(blob.motion - larger.motion)), np.hypot(*larger.motion)
    return bool(apart > _PARTS_APART * reach_px + 0.5 * speed)


def _sharing(
    things: Sequence[Followed], blobs: Sequence[Blob], found: dict[int, int]
) -> dict[int, list[int]]:
    """The things (rows) that each blob (column) shows together, where there are several."""
    if not things or not blobs:
        return {}
    boxes = np.stack([thing.box for thing in things])
    is_inside = overlaps(boxes, np.stack([blob.box for blob in blobs]))[1] >= _SHARED_INSIDE
    shared: dict[int, list[int]] = {}
    for column in np.flatnonzero(np.count_nonzero(is_inside, axis=0) > 1).tolist():
        within = [
            row
            for row in np.flatnonzero(is_inside[:, column]).tolist()
            if things[row].life is not Life.NEW
            and (things[row].life is not Life.LOST or found.get(row) == column)
            and found.get(row, column) == column
        ]
        least = _SHARED_LARGER * max((float(np.prod(things[r].size)) for r in within), default=0.0)
        if len(within) > 1 and float(np.prod(blobs[column].size)) > least:
            shared[column] = within
    return shared
