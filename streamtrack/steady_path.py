"""The steadiest views that a shaking camera's frames have room for.

A view is a quad in the pixels of its frame; its frame's own is the whole picture less a margin. A
path of views is the curve nearest to the own views that bends least: Whittaker's smoother of
second order ("On a new method of graduation", 1923), at the frames' own times. What has been shown
is where the path sets out from. A frame that would have to show what lies beyond its edge pulls
the path to the nearest view that it holds (penalty method), so that it bends in time and gently
instead of being stopped there.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]

_PULL = 1e3
"""Weight of a view that its frame holds, against that of a frame's own view."""
_MOST_ROUNDS = 8
_TAPER = 0.25
"""Over this last share of what is seen ahead frames count less and less: none comes in at once."""
_LEAST_WEIGHT = 0.02
_LEAST_APART_S = 1e-3
_FARTHEST = 0.5
"""Of the picture's sides: views that are further apart from one frame to the next are a cut."""


def mapped(matrices: Doubles, quads: Doubles) -> Doubles:
    """Quads (N, 4, 2) by matrices (N, 3, 3); NaN where a corner lies beyond the horizon."""
    points = quads @ np.swapaxes(matrices[:, :, :2], 1, 2) + matrices[:, None, :, 2]
    depths = points[:, :, 2:]
    is_before = np.all(depths * depths[:, :1] > 0, axis=1, keepdims=True)
    found: Doubles = points[:, :, :2] / np.where(is_before, depths, np.nan)
    return found


def frames_before_a_cut(here_from_frame: Doubles, own: Doubles) -> int:
    """How many of the frames (N, 3, 3), from the first on, the camera went through in one piece."""
    quads = mapped(here_from_frame, np.broadcast_to(own, (len(here_from_frame), 4, 2)))
    with np.errstate(invalid="ignore"):
        way = np.abs(np.diff(quads.mean(axis=1), axis=0)) <= _FARTHEST * np.ptp(own, axis=0)
        goes_on = way.all(axis=1) & (_areas(quads[1:]) > 0)
    return 1 + int(np.argmin(np.append(goes_on, False)))


def steadiest_views(
    times_s: Doubles, here_from_frame: Doubles, shown: Doubles, room: Room, bend_s: float
) -> Doubles:
    """Views (M, 4, 2) of the frames that come, each in its own pixels and within ``room``.

    ``times_s`` (K + M,) do not decrease. ``here_from_frame`` (K + M, 3, 3) takes each frame to the
    plane of one of them. The first K have been shown, as ``shown`` (K, 4, 2) in their own pixels.
    What lasts much less than ``bend_s`` seconds is not followed.
    """
    first = len(shown)
    apart_s = np.maximum(np.diff(times_s), _LEAST_APART_S)
    frames = here_from_frame[first:]
    own = mapped(frames, np.broadcast_to(room.own, (len(frames), 4, 2)))
    past = mapped(here_from_frame[:first], shown).reshape(first, 8)
    stiff = _bending(apart_s, bend_s)
    weights = _weights(apart_s)[first:]
    matrix = stiff[first:, first:] + np.diag(weights)
    aim = weights[:, None] * own.reshape(-1, 8) - stiff[first:, :first] @ past
    path = np.linalg.solve(matrix, aim).astype(np.float64)
    frame_from_here = np.linalg.inv(frames).astype(np.float64)
    for _ in range(_MOST_ROUNDS):
        held, is_beyond = room.held(mapped(frame_from_here, path.reshape(-1, 4, 2)))
        if not is_beyond.any():
            return held
        pull = np.where(is_beyond, _PULL * weights.max(), 0.0)
        aims = aim + pull[:, None] * np.nan_to_num(mapped(frames, held).reshape(-1, 8))
        path = np.linalg.solve(matrix + np.diag(pull), aims).astype(np.float64)
    return room.held(mapped(frame_from_here, path.reshape(-1, 4, 2)))[0]


class Room:
    """What a frame of a size (width, height) can show with a margin, given as a share of it."""

    def __init__(self, size_wh: tuple[int, int], margin: float) -> None:
        self._high = np.array(size_wh, np.float64) - 1
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * self._high
        self.own: Doubles = corners + (1 - 2 * corners / np.maximum(self._high, 1)) * (
            margin * self._high
        )
        """The view (4, 2) that lies in the frame's middle."""

    def held(self, views: Doubles) -> tuple[Doubles, npt.NDArray[np.bool_]]:
        """The nearest views (N, 4, 2) that stay in the frame, and which of them were beyond it.

        A view is moved; one that fits nowhere, too, is made as like the frame's own as it must.
        """
        is_known = np.all(np.isfinite(views), axis=(1, 2), keepdims=True)
        views = np.where(is_known, views, self.own)
        before = np.maximum(-views, 0).max(axis=1)
        after = np.maximum(views - self._high, 0).max(axis=1)
        is_beyond = ~is_known[:, 0, 0] | np.any((before > 0) | (after > 0), axis=1)
        if not is_beyond.any():
            return views, is_beyond
        moved = views + np.where((before > 0) & (after > 0), 0, before - after)[:, None]
        way = moved - self.own
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.where(way > 0, self._high - self.own, -self.own) / way
        shares = np.where(way == 0, 1.0, np.minimum(shares, 1.0)).min(axis=(1, 2))
        return self.own + shares[:, None, None] * way, is_beyond


def _bending(apart_s: Doubles, bend_s: float) -> Doubles:
    """Energy (N, N) of a path's bending: bend_s^4 times the integral of its squared curvature."""
    count = len(apart_s) + 1
    bends = np.zeros((max(count - 2, 0), count))
    rows = np.arange(len(bends))
    bends[rows, rows] = 1 / apart_s[:-1]
    bends[rows, rows + 1] = -1 / apart_s[:-1] - 1 / apart_s[1:]
    bends[rows, rows + 2] = 1 / apart_s[1:]
    energy: Doubles = bend_s**4 * (bends.T / ((apart_s[:-1] + apart_s[1:]) / 2)) @ bends
    return energy


def _weights(apart_s: Doubles) -> Doubles:
    """The time (N,) that each frame stands for, less towards the end."""
    if not len(apart_s):
        return np.ones(1)
    lasts = (np.append(apart_s, apart_s[-1]) + np.append(apart_s[0], apart_s)) / 2
    left = np.append(np.cumsum(apart_s[::-1])[::-1], 0) / (_TAPER * apart_s.sum())
    weights: Doubles = lasts * np.clip(left, _LEAST_WEIGHT, 1.0)
    return weights


def _areas(quads: Doubles) -> Doubles:
    """Signed areas (N,) of quads (N, 4, 2)."""
    across, down = quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
    areas: Doubles = (across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]) / 2
    return areas
