"""Automatic targets of one stream: found by their motion, confirmed, named, followed, ended.

Each frame is compared with the background (`background`); what stands out becomes blobs
(`blobs`), blobs are paired with the things that are known (`association`), and what stays unpaired
becomes a target once it has been seen to move for some frames. One that is hidden is lost, without
a place, and is taken up again under its name if it reappears in time; one that leaves just ends.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.auto.association import associate, found_again
from streamtrack.auto.background import BackgroundModel, Outstanding
from streamtrack.auto.blobs import Blob, Scene, find_blobs, frame_px
from streamtrack.auto.boxes import overlap, touched_edges, turning
from streamtrack.auto.contact import (
    align_all,
    carry,
    end_duplicates,
    hold,
    hold_to_edges,
    is_whole,
    note_contacts,
    own_things,
    portray,
    sight,
)
from streamtrack.auto.followed import Followed, Life, predict_all
from streamtrack.auto.motion import REST_PX, MotionField
from streamtrack.auto.places import (
    Moment,
    hidden_by,
    is_invertible,
    reduced,
    resting_share,
)
from streamtrack.camera.view_levels import filled
from streamtrack.frame_view import FrameView
from streamtrack.pyramid import Pyramid
from streamtrack.types import (
    CameraPose,
    Image,
    Mask,
    Matrix,
    Model,
    Points,
    Size,
    Track,
    TrackState,
)

Doubles: TypeAlias = npt.NDArray[np.float64]

_LEAST_WIDTH_PX = 24
_CONFIRMED_S = 0.12
_LEAST_HITS = 4
_MOVED_PX = 2.5  # grid pixels
_MOVED_SHARE = 0.06  # of its size
_STRAIGHT_SHARE = 0.5  # of its path
_FLOWED_SHARE = 0.3  # of its way, that its pixels must have moved along
_FAR_SHARE = 0.4  # of its size, beyond which that is not asked for: flow hardly sees small things
_MAX_MISSES = 2  # frames, of what is not confirmed yet
_COAST_S = 2.0
_SLOWER_AFTER_S = 0.5  # lost, until which it is thought to go on as fast
_MOST_TARGETS = 60
_LEAST_RESTING = 0.34  # of the picture's corners, for anything to be said to move by itself
_BROKEN_FRAMES = 5  # in a row, after which the scene is another one
_REACH_PX = 4.0  # grid pixels, beyond which nothing is found again
_REST_FRAMES = 8
_USUAL_STEP_S = 0.04
_MAX_STEP_S = 1.0


class AutoTargets:
    """Finds and follows what moves; names are ``<prefix>-1``, ``<prefix>-2`` ..., none twice.

    ``blobs`` is what stood out in the last frame.
    ``taken`` names are left out, and the numbers go on after ``count``.
    """

    def __init__(self, prefix: str = "auto", taken: Collection[str] = (), count: int = 0) -> None:
        self._prefix = prefix
        self._taken = frozenset(taken)
        self.count = count
        self.blobs: tuple[Blob, ...] = ()
        self._field = MotionField()
        self._background: BackgroundModel | None = None
        self._things: list[Followed] = []
        self._world_from_before: Matrix | None = None
        self._time_s = 0.0
        self._step_s = _USUAL_STEP_S
        self._broken = 0

    def expected(self) -> list[Track]:
        """Where the targets will be in the next frame if the camera stands: for its estimate."""
        return [
            self._track(thing, thing.box + np.tile(thing.velocity * self._step_s, 2))
            for thing in self._things
            if thing.life in (Life.SEEN, Life.CARRIED)
        ]

    def update(self, view: FrameView, pose: CameraPose, given: Sequence[Track]) -> list[Track]:
        """The targets in this frame; what belongs to the ``given`` ones is left to them."""
        step_s = self._clocked(view.frame.time_s)
        world_from_frame = pose.world_from_frame
        if world_from_frame is None or not is_invertible(world_from_frame):
            return self._blind("the camera's pose is not known")
        small, small_from_frame = reduced(view)
        if min(small.shape[:2]) < _LEAST_WIDTH_PX:
            return self._blind("the picture is too small")
        size_wh = (small.shape[1], small.shape[0])
        world_from_small = geometry.normalized(
            world_from_frame @ geometry.inverted(small_from_frame)
        )
        if self._background is None or self._background.size_wh != size_wh:
            self._background = BackgroundModel(size_wh, world_from_small)
        seen = self._background.compare(small, world_from_small, small_from_frame, pose.overlay)
        turn = self._predict(world_from_frame, view.frame.time_s, view.size_wh)
        self._end_covered(seen, pose.overlay)
        if not seen.is_explained:
            return self._broken_off(world_from_small, small, small_from_frame, pose.overlay)
        self._broken = 0
        motion = self._field.measure(seen)
        seen = self._background.with_young(seen, motion.changing)
        scene = find_blobs(seen, hidden_by(seen, given), motion)
        self.blobs = scene.blobs
        is_fixed = np.array_equal(world_from_frame, np.eye(3))
        moment = Moment(step_s, frame_px(seen), view.size_wh, is_fixed)
        align_all(self._things, view.pyramid, turn, moment)
        self._associate(scene, view.pyramid, moment)
        self._background.learn(seen, motion.moving, self._protected(seen))
        self._confirm(self._background, seen, scene, moment)
        end_duplicates(self._things, moment)
        self._end_left_places(self._background, scene, moment)
        return self._tracks()

    def _clocked(self, time_s: float) -> float:
        """Seconds since the frame before; the usual step where clocks jump."""
        step_s = time_s - self._time_s
        self._time_s = time_s
        if not 0 < step_s <= _MAX_STEP_S:
            return self._step_s
        self._step_s = step_s
        return step_s

    def _predict(self, world_from_frame: Matrix, time_s: float, size_wh: Size) -> complex:
        """Move all on to this frame; how the camera's motion turns and enlarges the picture."""
        turn = 1.0 + 0j
        if self._world_from_before is not None:
            frame_from_before = geometry.normalized(
                geometry.inverted(world_from_frame) @ self._world_from_before
            )
            for thing in self._things:
                if thing.life is Life.LOST and thing.lost_s > _SLOWER_AFTER_S:
                    thing.velocity = thing.velocity * 0.9
            predict_all(self._things, frame_from_before, time_s)
            turn = turning(frame_from_before, 0.5 * np.array(size_wh))
        self._world_from_before = world_from_frame
        return turn

    def _associate(self, scene: Scene, pyramid: Pyramid, moment: Moment) -> None:
        note_contacts(self._things, moment)
        met = [t for t in self._things if t.touches and sight(t, scene, moment)]
        found = associate(self._things, scene.blobs, _REACH_PX * moment.grid_px)
        pairs = list(found.pairs)
        for things, blob in found.shared:
            own = own_things(things, moment)
            for fragment in things:
                if not any(fragment is thing for thing in own):
                    fragment.life = Life.OVER
            if len(own) == 1:
                pairs.append((own[0], blob))
                continue
            unsighted = [thing for thing in own if thing not in met]
            for thing in unsighted:
                carry(thing, scene, moment)
                thing.resume(Life.CARRIED)
            hold_to_edges(own, blob)
            met += unsighted
        for thing, blob in pairs:
            if thing in met and not is_whole(thing, blob):
                continue  # a part of it, where its place is known better
            met.append(thing)
            thing.take(blob, moment.step_s, moment.size_wh)
            thing.resume(Life.SEEN)
            portray(thing, blob, scene)
            if thing.life is Life.SEEN and is_whole(thing, blob):
                hold(thing, pyramid, scene, moment)
        for thing in self._things:
            if thing not in met:
                self._miss(thing, scene, moment)
        self._things = [thing for thing in self._things if not _is_over(thing, moment.size_wh)]
        self._things += [
            Followed.begun(blob, self._time_s, moment.step_s)
            for blob in found.free
            if not self._is_claimed(blob)
        ]

    def _miss(self, thing: Followed, scene: Scene, moment: Moment) -> None:
        """It was found nowhere: its pixels may still show it, else it is lost."""
        thing.misses += 1
        if thing.life in (Life.NEW, Life.OVER):
            return
        if thing.life is not Life.LOST and (
            sight(thing, scene, moment) or carry(thing, scene, moment)
        ):
            thing.life = Life.CARRIED
            return
        thing.life = Life.LOST
        thing.lost_s += moment.step_s
        thing.reason = "hidden, or no longer told from the background"

    def _end_left_places(self, background: BackgroundModel, scene: Scene, moment: Moment) -> None:
        """End what only marks the place that something left, and heal the background there."""
        for thing in self._things:
            if thing.life not in (Life.SEEN, Life.CARRIED):
                continue
            thing.note_rest(REST_PX * moment.grid_px, moment.step_s)
            if thing.still >= _REST_FRAMES and thing.still % _REST_FRAMES == 0:
                _end_left_place(thing, background, scene)
        self._things = [thing for thing in self._things if thing.life is not Life.OVER]

    def _end_covered(self, seen: Outstanding, overlay: Sequence[Points]) -> None:
        """End what was taken for a thing and is found to lie over every picture."""
        if not overlay:
            return
        covers = filled(overlay, seen.grid_from_frame, seen.clear.shape)
        self._things = [
            thing
            for thing in self._things
            if not _is_mostly(filled([thing.quad], seen.grid_from_frame, covers.shape), covers)
        ]

    def _is_claimed(self, blob: Blob) -> bool:
        return any(
            overlap(blob.box, thing.box)[1] > 0.6
            for thing in self._things
            if thing.life in (Life.SEEN, Life.CARRIED)
        )

    def _confirm(
        self, background: BackgroundModel, seen: Outstanding, scene: Scene, moment: Moment
    ) -> None:
        """Name the things that have been seen often enough and have moved."""
        least = max(_LEAST_HITS, round(_CONFIRMED_S / self._step_s))
        named = sum(thing.life is not Life.NEW for thing in self._things)
        ripe = [
            thing
            for thing in self._things
            if thing.life is Life.NEW
            and not thing.misses
            and thing.hits >= least
            and _has_moved(thing, moment.grid_px)
        ]
        if not ripe:
            return
        if not moment.is_fixed:
            resting = resting_share(seen, scene.motion, self._protected(seen))
            if resting < _LEAST_RESTING:
                return
        for thing in ripe[: max(0, _MOST_TARGETS - named)]:
            if _end_left_place(thing, background, scene):
                continue
            before = found_again(thing, self._things, _REACH_PX * moment.grid_px)
            if before is not None:
                before.life = Life.OVER
                thing.name, thing.home = before.name, before.home
            else:
                thing.name, thing.home = self._next_name(), thing.box.copy()
            thing.life = Life.SEEN
        self._things = [thing for thing in self._things if thing.life is not Life.OVER]

    def _next_name(self) -> str:
        while True:
            self.count += 1
            name = f"{self._prefix}-{self.count}"
            if name not in self._taken:
                return name

    def _protected(self, seen: Outstanding) -> Mask:
        """Where targets are: there the background learns nothing."""
        there = [t.quad for t in self._things if t.life in (Life.SEEN, Life.CARRIED)]
        return filled(there, seen.grid_from_frame, seen.clear.shape)

    def _blind(self, reason: str) -> list[Track]:
        """A frame in which nothing can be seen: the targets are lost, or end."""
        self.blobs = ()
        for thing in self._things:
            if thing.life is not Life.NEW:
                thing.life, thing.reason = Life.LOST, reason
                thing.lost_s += self._step_s
            thing.time_s = self._time_s
        self._things = [
            thing
            for thing in self._things
            if thing.life is not Life.NEW and thing.lost_s <= _COAST_S
        ]
        return self._tracks()

    def _broken_off(
        self,
        world_from_small: Matrix,
        small: Image,
        small_from_frame: Matrix,
        overlay: Sequence[Points],
    ) -> list[Track]:
        """Most of the picture changed at once: a flash, or another scene if it stays so."""
        self._broken += 1
        if self._broken < _BROKEN_FRAMES:
            return self._blind("most of the picture changed at once")
        self._things, self._broken = [], 0
        self._background = BackgroundModel((small.shape[1], small.shape[0]), world_from_small)
        seen = self._background.compare(small, world_from_small, small_from_frame, overlay)
        nothing = np.zeros(seen.clear.shape, np.bool_)
        self._background.learn(seen, nothing, nothing)
        return []

    def _tracks(self) -> list[Track]:
        named = [thing for thing in self._things if thing.life is not Life.NEW]
        named.sort(key=lambda thing: int(thing.name.rpartition("-")[2]))
        return [self._track(thing, thing.box) for thing in named]

    def _track(self, thing: Followed, box: Doubles) -> Track:
        if thing.life is Life.LOST:
            return Track(
                thing.name, TrackState.LOST, means="motion", reason=thing.reason, is_found=True
            )
        assert thing.home is not None
        x0, y0, x1, y1 = box
        return Track(
            thing.name,
            TrackState.TRACKING,
            quad=geometry.box_quad(x0, y0, x1 - x0, y1 - y0),
            frame_from_template=_box_from_box(box, thing.home),
            model=Model.AFFINE,
            means="motion" if thing.life is Life.SEEN else "carried",
            is_found=True,
        )


def _end_left_place(thing: Followed, background: BackgroundModel, scene: Scene) -> bool:
    """End a thing if it only marks the place that something left, and heal the background."""
    there = filled([thing.quad], scene.grid_from_frame, scene.solid.shape) & scene.solid
    if not background.has_left(there):
        return False
    background.heal(there)
    thing.life = Life.OVER
    return True


def _is_mostly(place: Mask, there: Mask) -> bool:
    """Does most of a place (h, w) lie there?"""
    return bool(np.count_nonzero(place & there) > 0.5 * np.count_nonzero(place))


def _is_over(thing: Followed, size_wh: Size) -> bool:
    if thing.life is Life.NEW:
        return thing.misses > _MAX_MISSES
    middle, size = thing.center, np.array(size_wh)
    if bool((middle < 0).any() or (middle > size - 1).any()):
        return True
    if thing.life is not Life.LOST:
        return thing.life is Life.OVER
    edges = touched_edges(thing.box, size_wh)
    outward = np.concatenate([thing.velocity < 0, thing.velocity > 0])
    return bool((edges & outward).any()) or thing.lost_s > _COAST_S


def _has_moved(thing: Followed, frame_px: float) -> bool:
    """Has it come far enough, straight enough, and did its own pixels move that way?"""
    moved = thing.center - thing.origin
    far = float(np.hypot(*moved))
    if far < max(_MOVED_PX * frame_px, _MOVED_SHARE * float(np.hypot(*thing.size))):
        return False
    if far < _STRAIGHT_SHARE * thing.path_px:
        return False
    if thing.flow_px is None or far >= _FAR_SHARE * float(np.hypot(*thing.size)):
        return True
    return float(thing.flow_px @ moved) >= _FLOWED_SHARE * far * far


def _box_from_box(box: Doubles, home: Doubles) -> Matrix:
    """The upright affinity that takes one box to another."""
    factor = (box[2:] - box[:2]) / np.maximum(home[2:] - home[:2], 1e-6)
    shift = box[:2] - factor * home[:2]
    return np.array([[factor[0], 0.0, shift[0]], [0.0, factor[1], shift[1]], [0.0, 0.0, 1.0]])
