"""Which blob is which thing: fragments are put together, blobs of several things are told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack.auto.assignment import assign
from streamtrack.auto.blobs import Blob, united_blob
from streamtrack.auto.followed import Followed, Life, overlap

Doubles: TypeAlias = npt.NDArray[np.float64]

_MAX_COST = 1.2
_FRAGMENT_INSIDE = 0.7  # of a fragment's area that lies in the predicted box
_FRAGMENT_SHARE = 0.4  # of the largest of them
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
    wholes = _put_together(things, blobs)
    costs = np.array([[_cost(thing, blob, reach_px) for blob in wholes] for thing in things])
    found = dict(assign(costs.reshape(len(things), len(wholes))))
    shared = {column: _sharing(things, blob, column, found) for column, blob in enumerate(wholes)}
    shared = {column: rows for column, rows in shared.items() if rows}
    told = {row for rows in shared.values() for row in rows}
    taken = set(found.values())
    return Associated(
        tuple((things[row], wholes[column]) for row, column in found.items() if row not in told),
        tuple((tuple(things[r] for r in rows), wholes[c]) for c, rows in shared.items()),
        tuple(blob for column, blob in enumerate(wholes) if column not in taken),
    )


def color_distance(one: Doubles, other: Doubles) -> float:
    """Hellinger distance (0..1) of two histograms."""
    return float(np.sqrt(max(0.0, 1.0 - float(np.sum(np.sqrt(one * other))))))


def _cost(thing: Followed, blob: Blob, reach_px: float) -> float:
    """How unlike a thing where it should be is a blob; infinite beyond the gate."""
    off = float(np.hypot(*(thing.center - blob.center)))
    extent = 0.5 * float(np.hypot(*thing.size) + np.hypot(*blob.size))
    gate_px = 0.6 * extent + reach_px
    color = color_distance(thing.colors, blob.colors)
    if thing.life is Life.LOST:
        gate_px = 0.6 * extent + reach_px + 0.5 * thing.lost_s * float(np.hypot(*thing.velocity))
        ratio = float(np.prod(blob.size) / np.prod(thing.size))
        if color > _MAX_COLOR_DISTANCE or not 1 / 3 < ratio < 3:
            return np.inf
    iou, _ = overlap(thing.box, blob.box)
    if off > gate_px and iou < 0.1:
        return np.inf
    late = 0.5 if thing.life is Life.LOST else 0.25 if thing.life is Life.NEW else 0.0
    cost = (1 - iou) + 0.5 * off / gate_px + 0.3 * color + late
    return cost if cost < _MAX_COST + late + 0.5 else np.inf


def _put_together(things: Sequence[Followed], blobs: Sequence[Blob]) -> list[Blob]:
    """The blobs, those that are fragments of one thing made one."""
    remaining = list(blobs)
    for thing in sorted(things, key=lambda thing: -float(np.prod(thing.size))):
        if thing.life in (Life.NEW, Life.LOST):
            continue
        reach = 0.1 * thing.size
        around = thing.box + np.concatenate([-reach, reach])
        parts = [
            blob
            for blob in remaining
            if overlap(blob.box, around)[1] >= _FRAGMENT_INSIDE
            and not any(
                other is not thing and overlap(other.box, blob.box)[0] > 0.5 for other in things
            )
        ]
        sizes = sorted(float(np.prod(part.size)) for part in parts)
        if len(parts) < 2 or sizes[-2] > _FRAGMENT_SHARE * sizes[-1]:
            continue  # two that are alike in size are two things
        whole = united_blob(parts)
        best = max(overlap(part.box, thing.box)[0] for part in parts)
        if overlap(whole.box, thing.box)[0] > best:
            remaining = [blob for blob in remaining if not any(blob is part for part in parts)]
            remaining.append(whole)
    return remaining


def _sharing(
    things: Sequence[Followed], blob: Blob, column: int, found: dict[int, int]
) -> list[int]:
    """The things (rows) that a blob shows together; none if it shows one at most."""
    area = float(np.prod(blob.size))
    within = [
        row
        for row, thing in enumerate(things)
        if thing.life is not Life.NEW
        and (thing.life is not Life.LOST or found.get(row) == column)
        and found.get(row, column) == column
        and overlap(thing.box, blob.box)[1] >= _SHARED_INSIDE
    ]
    is_larger = all(area > _SHARED_LARGER * float(np.prod(things[row].size)) for row in within)
    return within if len(within) > 1 and is_larger else []
