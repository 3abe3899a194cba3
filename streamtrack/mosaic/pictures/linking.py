"""Linking a set of pictures: the likely pairs first, and no more of them than the set needs.

An unordered set of N pictures has N (N - 1) / 2 pairs, and most share nothing. A vote with the
strongest few features of each picture says cheaply which do; a picture that is well linked
already is not linked to more of the same part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from streamtrack.matching import match
from streamtrack.mosaic.job import MosaicProgress
from streamtrack.mosaic.pairs.registering import PictureRegistrar
from streamtrack.mosaic.pictures.graph import largest_part
from streamtrack.mosaic.types import Link, Picture
from streamtrack.settings import MatchingSettings
from streamtrack.types import Features

_ALL_PAIRS_UP_TO = 8
_VOTING_FEATURES = 300
_MIN_VOTES = 6
_PARTNERS = 8
_ENOUGH_LINKS = 4
_SECOND_LOOKS = 3

Pair = tuple[int, int]


def link_pictures(
    pictures: Sequence[Picture],
    registrar: PictureRegistrar,
    settings: MatchingSettings,
    progress: MosaicProgress,
    should_stop: Callable[[], bool],
) -> list[Link]:
    """All links that were tried, the refused ones too; fewer if asked to stop.

    Pictures that no link reaches after that get a second, more thorough look at their likeliest
    partners.
    """
    pairs = candidate_pairs(pictures, settings)
    progress.begin("matching", len(pairs))
    links: dict[Pair, Link] = {}
    parts = {picture.index: picture.index for picture in pictures}
    accepted = dict.fromkeys(parts, 0)
    for i, j in pairs:
        if should_stop():
            return list(links.values())
        a, b = pictures[i], pictures[j]
        is_tied = parts[a.index] == parts[b.index]
        if not (is_tied and min(accepted[a.index], accepted[b.index]) >= _ENOUGH_LINKS):
            link = registrar.link(a, b, is_thorough=len(pictures) == 2)
            links[i, j] = link
            if link.b_from_a is not None:
                accepted[a.index] += 1
                accepted[b.index] += 1
                _join(parts, a.index, b.index)
        progress.advance()
    for i, j in _second_looks(pictures, pairs, links):
        if should_stop():
            break
        links[i, j] = registrar.link(pictures[i], pictures[j], is_thorough=True)
    return list(links.values())


def candidate_pairs(pictures: Sequence[Picture], settings: MatchingSettings) -> list[Pair]:
    """Pairs (i, j), i < j, of places in the sequence worth a registration, likeliest first.

    All of them in small sets. In larger ones the `_PARTNERS` most voted of each picture and its
    neighbour in the sequence, where a vote is a mutual match among the strongest features.
    """
    count = len(pictures)
    if count == 2:
        return [(0, 1)]
    strongest = [_strongest(picture.features, _VOTING_FEATURES) for picture in pictures]
    votes = np.zeros((count, count), np.int64)
    for i in range(count):
        for j in range(i + 1, count):
            votes[i, j] = votes[j, i] = len(match(strongest[i], strongest[j], settings))
    if count <= _ALL_PAIRS_UP_TO:
        chosen = {(i, j) for i in range(count) for j in range(i + 1, count)}
    else:
        chosen = {(i, i + 1) for i in range(count - 1)}
        for i in range(count):
            order = np.argsort(-votes[i], kind="stable")[:_PARTNERS]
            chosen |= {(min(i, int(j)), max(i, int(j))) for j in order if votes[i, j] >= _MIN_VOTES}
    return sorted(chosen, key=lambda pair: (-int(votes[pair]), pair))


def _strongest(features: Features, count: int) -> Features:
    if len(features) <= count:
        return features
    rows = np.argpartition(-features.responses, count)[:count]
    return features[np.sort(rows)]


def _join(parts: dict[int, int], a: int, b: int) -> None:
    old, new = parts[b], parts[a]
    for picture, part in parts.items():
        if part == old:
            parts[picture] = new


def _second_looks(
    pictures: Sequence[Picture], pairs: Sequence[Pair], links: dict[Pair, Link]
) -> list[Pair]:
    """Refused pairs of each picture outside the main part with pictures in it, likeliest first."""
    if len(pictures) == 2:
        return []
    good = [link for link in links.values() if link.b_from_a is not None]
    part = largest_part((picture.index for picture in pictures), good)
    inside = set(part.members) if part is not None else {pictures[0].index}
    looks: list[Pair] = []
    for row, picture in enumerate(pictures):
        if picture.index not in inside:
            own = [
                pair
                for pair in pairs
                if row in pair and {pictures[pair[0]].index, pictures[pair[1]].index} & inside
            ]
            looks += [pair for pair in own[:_SECOND_LOOKS] if pair not in looks]
    return looks
