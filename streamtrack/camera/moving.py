"""Camera motion: where each frame lies in the world, the pixel frame of the first keyframe.

A moving camera is aligned with a keyframe, not with the frame before: consecutive frames differ
too little, and their errors would add up. A new keyframe is taken when the view has moved on,
always from a sharp frame whose own pose passed the gate. What does not pass changes nothing: the
pose is unknown until a later frame is recognised, near where the camera was or by the features of
any keyframe.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import hypot
from typing import Protocol

import numpy as np

from streamtrack import geometry
from streamtrack.camera.following import PointMotion, followed, is_majority, is_surprising
from streamtrack.camera.keyframe_links import LevelCache, NewKeyframe, link_of, overlapping
from streamtrack.camera.keyframes import KeyframeGraph
from streamtrack.camera.layers import Compared, Doubts, is_contradicted, separated
from streamtrack.camera.loops import LoopCloser
from streamtrack.camera.picture_overlay import OverlayWatch
from streamtrack.camera.placed import Placed, Sight, State
from streamtrack.camera.relocalising import Relocaliser
from streamtrack.camera.view_alignment import align, align_exactly
from streamtrack.camera.view_levels import ReferenceView, ViewLevels
from streamtrack.camera.view_verdict import ViewAlignment
from streamtrack.fitting import fit
from streamtrack.frame_view import FrameView
from streamtrack.mosaic.types import Link
from streamtrack.settings import Settings
from streamtrack.types import CameraPose, Matrix, Model, Points, Size, Track, Verdict

_MIN_OVERLAP = 0.6
_MIN_FIRST_OVERLAP = 0.75  # of the keyframes that tell how the first one, the world, is tilted
_FIRST_KEYFRAMES = 8
_MIN_OVERLAP_UNSHARP = 0.45  # below which a blurred frame, too, becomes a keyframe
_MIN_SHARPNESS = 0.75
_MIN_AGREEING_CELLS = 30
_MIN_LASTING_SHARE = 0.5  # of agreeing cells; below it the scene itself has changed
_MAX_LASTING_SIGMA_PX = 1.0  # of the corners; above it a keyframe holds too little of a frame
_MIN_SPACING = 3  # frames between keyframes that are taken for that alone
_MIN_REUSED_OVERLAP = 0.8
_MIN_TEXTURED_CELLS = 12
_MAX_STRETCH = 4.0
_MAX_LAST_OVERLAP = 0.9  # with its keyframe, of a view that is kept when the camera is lost
_SHAPE_SHARE = 0.006  # of the view, that a similarity must miss of a motion that has a shape
_REFERENCES_KEPT = 6
_MARGIN_PX = 8.0  # of the usual level, around the targets
_MOST_LIVE_FRAMES = 200_000
"""Poses of frames remembered of a stream without end, besides those in a mosaic: two hours."""


class CameraEstimator(Protocol):
    """What a run asks of a camera model."""

    @property
    def graph(self) -> KeyframeGraph | None:
        """The keyframes, whose poses may still change until `close`; None if there are none."""
        ...

    def update(self, view: FrameView, tracks: Sequence[Track]) -> CameraPose:
        """The camera's pose in the next frame; ``tracks`` are its targets, which may move."""
        ...

    def close(self) -> None:
        """Finish what is still at work; poses are final then."""
        ...


class MovingCamera:
    """A camera that moves over a scene that is flat, or far, or seen from one place.

    ``graph`` holds the keyframes; its poses may still change until `close`.
    """

    def __init__(self, settings: Settings, *, is_live: bool = False) -> None:
        self.graph = KeyframeGraph(most_frames=_MOST_LIVE_FRAMES if is_live else None)
        self._levels = LevelCache(self.graph)
        self._loops = LoopCloser(self.graph, is_live)
        self._relocaliser = Relocaliser(self.graph, settings)
        self._references: dict[int, ReferenceView] = {}
        self._doubts = Doubts()
        self._overlay = OverlayWatch()
        self._state: State | None = None

    def update(self, view: FrameView, tracks: Sequence[Track]) -> CameraPose:
        """The camera's pose in the next frame; targets' quads are left out of account."""
        self._loops.advance()
        state = self._state
        if state is not None and view.levels.is_flat():
            return CameraPose(None, reason=str(Verdict.TOO_FEW_FEATURES))
        over = self._overlay.look(view.levels)
        sight = Sight(view, _outlines(tracks, view.levels), over.quads, over.shown)
        if state is None:
            return self._begin(sight)
        reference = self._reference(state.keyframe)
        points = PointMotion(reference, state, sight)
        placed = Placed(state.keyframe, followed(reference, state, sight, points))
        if placed.keyframe_from_frame is None:
            self._keep_last_view(state)
            recognised = self._recognise(sight)
            if recognised is None:
                return placed.refusal()
            placed = recognised
        placed = self._background(placed, sight, points)
        if placed.keyframe_from_frame is None:
            return placed.refusal()
        self._relocaliser.rest()
        return self._accepted(placed, sight)

    def close(self) -> None:
        """Finish the work on loops: the graph's poses are final then."""
        self._loops.close()

    def _begin(self, sight: Sight) -> CameraPose:
        reference = ReferenceView(sight.levels, sight.hidden)
        cells = reference.textured_cells
        if cells < _MIN_TEXTURED_CELLS:
            return CameraPose(None, reason=str(Verdict.TOO_FEW_FEATURES))
        index = sight.index
        self._take(sight.view, reference, np.eye(3), None)
        self._state = State(index, np.eye(3), sight)
        return CameraPose(
            np.eye(3),
            cells,
            cells,
            0.0,
            keyframe=index,
            is_keyframe=True,
            sigma_px=0.0,
            overlay=sight.overlay,
        )

    def _keep_last_view(self, state: State) -> None:
        """The frame last placed becomes a keyframe, as it may show most of what a jump left."""
        placed, sight = state.placed, state.sight
        if placed is None or placed.overlap(sight) >= _MAX_LAST_OVERLAP:
            return
        if _is_lasting(placed.found):
            self._extend(placed, sight, None)

    def _recognise(self, sight: Sight) -> Placed | None:
        """The keyframe that a frame shows by its features, and the alignment that confirms it."""
        assert self._state is not None
        for keyframe, guess in self._relocaliser.candidates(self._state.keyframe, sight):
            found = align(self._reference(keyframe), sight.levels, guess, sight.hidden)
            if found.reference_from_view is not None:
                return Placed(keyframe, found)
        return None

    def _background(self, placed: Placed, sight: Sight, points: PointMotion) -> Placed:
        """The alignment of what lies behind, where the one found has doubtful support.

        What moves before it is left out of the keyframe from then on.
        """
        keyframe, found, state = placed.keyframe, placed.found, self._state
        assert state is not None
        compared = Compared(self._reference(keyframe), sight.levels, found)
        is_followed = keyframe == state.keyframe
        if is_followed and is_surprising(found, state, sight):
            expected = state.predicted(sight.time_s)
            is_vague = state.is_old(sight.time_s) and not is_majority(found)
            if is_vague or is_contradicted(compared, expected):
                return Placed(keyframe, found.refused(Verdict.UNCERTAIN))
        if not self._doubts.are_due(keyframe, found):
            return placed
        guess = points.guess if is_followed else None
        layers = separated(compared, sight.hidden, guess)
        self._hide(keyframe, layers.foreground)
        return Placed(keyframe, layers.background)

    def _hide(self, keyframe: int, outlines: Sequence[Points]) -> None:
        """Leave what these quads hold out of a keyframe from now on."""
        if not outlines:
            return
        reference = self._reference(keyframe)
        reference = ReferenceView(reference.levels, (*reference.hidden, *outlines))
        self.graph.hide(keyframe, reference.hidden)
        self._keep_reference(keyframe, reference)

    def _accepted(self, placed: Placed, sight: Sight) -> CameraPose:
        """The pose of a frame in a keyframe; goes over to another one where that is better."""
        keyframe, found = placed.keyframe, placed.found
        keyframe_from_frame = self.graph.lens.flat(found, sight.size_wh)
        world_from_frame = self._in_world(keyframe, keyframe_from_frame)
        before = self._state
        self._remember(placed, sight)
        if _stretch(world_from_frame, sight.size_wh) > _MAX_STRETCH:
            return placed.camera_pose(None, Verdict.STRETCHED)
        self.graph.add_frame(sight.index, keyframe, keyframe_from_frame)
        self._hide(keyframe, self._overlay.note(sight.levels, world_from_frame))
        is_keyframe = False
        if self._has_moved_on(placed, sight):
            other = self._better_keyframe(placed, sight, world_from_frame)
            if other is not None:
                keyframe = other
            elif self._extend(placed, sight, before):
                keyframe, is_keyframe = sight.index, True
            moved = self.graph.world_from_frame(sight.index)
            world_from_frame = world_from_frame if moved is None else moved
        pose = placed.camera_pose(world_from_frame)
        sigma_px = hypot(self.graph.sigma_px(keyframe), found.corner_sigma_px)
        return replace(
            pose,
            keyframe=keyframe,
            is_keyframe=is_keyframe,
            sigma_px=sigma_px,
            overlay=sight.overlay,
        )

    def _in_world(self, keyframe: int, keyframe_from_frame: Matrix) -> Matrix:
        world_from_keyframe = self.graph.keyframes[keyframe].world_from_keyframe
        return geometry.normalized(world_from_keyframe @ keyframe_from_frame)

    def _remember(self, placed: Placed, sight: Sight) -> None:
        state = self._state
        step, step_s = None, 0.0
        is_later = state is not None and sight.time_s > state.sight.time_s
        if state is not None and is_later and state.keyframe == placed.keyframe:
            motion = geometry.inverted(state.keyframe_from_frame) @ placed.pose
            step = _simplified(motion, sight.size_wh)
            step_s = sight.time_s - state.sight.time_s
        self._state = State(placed.keyframe, placed.pose, sight, placed, step, step_s)

    def _go_over(self, keyframe: int, keyframe_from_frame: Matrix) -> None:
        """Go on from another keyframe; the motion from frame to frame stays."""
        state = self._state
        assert state is not None
        self._state = replace(
            state, keyframe=keyframe, keyframe_from_frame=keyframe_from_frame, placed=None
        )

    def _has_moved_on(self, placed: Placed, sight: Sight) -> bool:
        found = placed.found
        is_first = len(self.graph.keyframes) < _FIRST_KEYFRAMES
        least = _MIN_FIRST_OVERLAP if is_first else _MIN_OVERLAP
        if found.inliers < _MIN_AGREEING_CELLS or placed.overlap(sight) < least:
            return True
        has_changed = not _is_lasting(found) or found.corner_sigma_px > _MAX_LASTING_SIGMA_PX
        return has_changed and sight.index >= placed.keyframe + _MIN_SPACING

    def _better_keyframe(
        self, placed: Placed, sight: Sight, world_from_frame: Matrix
    ) -> int | None:
        """A keyframe taken earlier that sees nearly all of the frame, and agrees with it."""
        keyframes = self.graph.keyframes
        shares = overlapping(keyframes, world_from_frame, sight.size_wh, _MIN_REUSED_OVERLAP)
        for _, other in shares[:1]:
            if other == placed.keyframe:
                continue
            pose = keyframes[other].world_from_keyframe
            guess = geometry.normalized(geometry.inverted(pose) @ world_from_frame)
            found = align(self._reference(other), sight.levels, guess, sight.hidden)
            if found.reference_from_view is not None:
                self._go_over(other, found.reference_from_view)
                other_from_frame = self.graph.lens.flat(found, sight.size_wh)
                self.graph.add_frame(sight.index, other, other_from_frame)
                return other
        return None

    def _extend(self, placed: Placed, sight: Sight, before: State | None) -> bool:
        """Take the frame as a keyframe if it is sharp and its place beyond doubt.

        It is measured exactly later, unless so little agrees that it must be done at once.
        """
        keyframe, found = placed.keyframe, placed.found
        lens, size_wh = self.graph.lens, sight.size_wh
        keyframe_from_frame = lens.flat(found, size_wh)
        is_sharp = found.sharpness >= _MIN_SHARPNESS
        if not is_sharp and placed.overlap(sight) >= _MIN_OVERLAP_UNSHARP:
            return False
        index = sight.index
        reference = self._new_reference(placed, sight, before)
        if reference is None:
            return False
        link = link_of(index, keyframe, found)
        is_sure = found.inliers >= _MIN_AGREEING_CELLS
        if not is_sure:
            guess = geometry.inverted(placed.pose)
            there = self.graph.keyframes[keyframe].hidden
            exact = align_exactly(reference, self._levels.get(keyframe), guess, there)
            if exact.reference_from_view is None:
                return False
            keyframe_from_frame = geometry.inverted(lens.flat(exact, size_wh))
            link = link_of(keyframe, index, exact)
        self._take(sight.view, reference, self._in_world(keyframe, keyframe_from_frame), link)
        self._go_over(index, np.eye(3))
        self._loops.add(NewKeyframe(index, reference, keyframe, found if is_sure else None))
        return True

    def _new_reference(
        self, placed: Placed, sight: Sight, before: State | None
    ) -> ReferenceView | None:
        """The view of a new keyframe, without what has moved by itself since the frame before.

        None if it is not known which of two motions in it is the background's.
        """
        levels, hidden = sight.levels, sight.hidden
        reference = ReferenceView(levels, hidden)
        keyframe = placed.keyframe
        if before is None or before.keyframe != keyframe or not self._doubts.about(keyframe):
            return reference
        here_from_before = geometry.inverted(placed.pose) @ before.keyframe_from_frame
        ours = replace(placed.found, reference_from_view=here_from_before)
        layers = separated(Compared(reference, before.sight.levels, ours), hidden)
        if layers.background.reference_from_view is None:
            return None
        if layers.background is not ours or not layers.foreground:
            return reference
        self._doubts.go_on(sight.index)
        return ReferenceView(levels, (*hidden, *layers.foreground))

    def _take(
        self, view: FrameView, reference: ReferenceView, world_from_frame: Matrix, link: Link | None
    ) -> None:
        frame = view.frame
        outlines = reference.hidden
        self.graph.add_keyframe(frame.index, frame.time_s, view.grey, world_from_frame, outlines)
        if link is not None:
            self.graph.add_link(link, is_loop=False)
        self._levels.add(frame.index, reference.levels)
        self._keep_reference(frame.index, reference)

    def _reference(self, keyframe: int) -> ReferenceView:
        reference = self._references.get(keyframe)
        if reference is None:
            hidden = self.graph.keyframes[keyframe].hidden
            reference = ReferenceView(self._levels.get(keyframe), hidden)
            self._keep_reference(keyframe, reference)
        return reference

    def _keep_reference(self, keyframe: int, reference: ReferenceView) -> None:
        self._references[keyframe] = reference
        while len(self._references) > _REFERENCES_KEPT:
            del self._references[next(iter(self._references))]


def _outlines(tracks: Sequence[Track], levels: ViewLevels) -> list[Points]:
    """The targets' quads with a margin: what moves tinges the local means of what is next to it."""
    margin_px = _MARGIN_PX * levels.size_wh[0] / levels.usual.shape[1]
    return [geometry.grown_quad(t.quad, margin_px) for t in tracks if t.quad is not None]


def _is_lasting(found: ViewAlignment) -> bool:
    """Is most of what a keyframe showed still there?"""
    return found.inliers >= _MIN_LASTING_SHARE * len(found.is_inlier)


def _simplified(motion: Matrix, size_wh: Size) -> Matrix:
    """A motion from frame to frame as a similarity; as an affinity if that has clearly a shape.

    What is added to a motion of fewer freedoms is noise, which grows when the motion is continued.
    """
    quad = geometry.image_quad(size_wh)
    moved = geometry.transform_points(motion, quad)
    similar = fit(Model.SIMILARITY, quad, moved)
    off_px = float(np.abs(geometry.transform_points(similar, quad) - moved).max())
    return fit(Model.AFFINE, quad, moved) if off_px > _SHAPE_SHARE * size_wh[0] else similar


def _stretch(world_from_frame: Matrix, size_wh: Size) -> float:
    """Area of the box around the frame in the world, against the frame's own."""
    quad = geometry.transform_points(world_from_frame, geometry.image_quad(size_wh))
    if not np.isfinite(quad).all():
        return float("inf")
    x0, y0, x1, y1 = geometry.bounding_box(quad)
    return (x1 - x0) * (y1 - y0) / (size_wh[0] * size_wh[1])
