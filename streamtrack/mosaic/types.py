"""The values that mosaics are made of. Conventions as in `streamtrack.types`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.pyramid import Pyramid
from streamtrack.types import (
    Features,
    Image,
    Mask,
    Matches,
    Matrix,
    Model,
    Points,
    Registration,
    Size,
    Verdict,
)

if TYPE_CHECKING:
    from streamtrack.pose_graph import KeyframeEdge


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture to be placed in a mosaic, with its features (full-resolution pixels).

    ``index`` is its place among the inputs (command line, or frame of the stream) from 0.
    ``cover`` (H, W) is 255 where a picture with transparency is opaque, else 0.
    """

    index: int
    name: str
    image: Image
    features: Features
    cover: Image | None = None

    @property
    def size_wh(self) -> Size:
        return self.image.shape[1], self.image.shape[0]

    @cached_property
    def pyramid(self) -> Pyramid:
        """The picture in grey at halved resolutions, one for all its links."""
        return Pyramid(geometry.grey_of(self.image))


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A gated mapping between pictures ``a`` and ``b`` (their indices), with its evidence.

    ``a_points`` and ``b_points``, float32 (M, 2), are the pairs the estimate rests on (sub-pixel,
    full-resolution pixels), ``registration.is_inlier`` (M,) tells which agree and
    ``registration.b_from_a`` is None when refused. ``matches`` counts the pairs of the descriptor
    matching itself. ``rmse_px`` is the inliers' symmetric transfer RMSE, ``overlap_ncc`` the
    normalised cross-correlation of the two pictures where they overlap; NaN if not measured.
    """

    a: int
    b: int
    a_points: Points
    b_points: Points
    registration: Registration
    matches: Matches
    rmse_px: float = float("nan")
    overlap_ncc: float = float("nan")

    @property
    def b_from_a(self) -> Matrix | None:
        return self.registration.b_from_a

    @property
    def model(self) -> Model | None:
        return self.registration.model

    @property
    def verdict(self) -> Verdict:
        return self.registration.verdict


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """Poses after adjustment, and how well the links agree with them.

    world_from_picture  the pictures that used links connect with the anchor (or a fixed picture)
    model               the model of the poses
    rmse_px             of the used links, each counting the same, in picture pixels, or NaN
    link_rmse_px        float64 (L,), error of each link's own inlier pairs, NaN if not measured
    is_used             bool (L,), False for links that were refused before, or reject here
    """

    world_from_picture: dict[int, Matrix]
    model: Model
    rmse_px: float
    link_rmse_px: npt.NDArray[np.float64]
    is_used: Mask

    @property
    def rejected(self) -> tuple[int, ...]:
        """Rows of the measured links that disagree with the others."""
        wrong = np.flatnonzero(~self.is_used & np.isfinite(self.link_rmse_px))
        return tuple(int(row) for row in wrong)


class Status(StrEnum):
    """What became of a picture or frame."""

    USED = "used"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where a picture came to lie; ``world_from_picture`` is None if skipped, with the reason."""

    index: int
    name: str
    features: int
    status: Status
    reason: str = ""
    world_from_picture: Matrix | None = None
    time_s: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class MosaicView:
    """A growing mosaic as a person may see it at one moment.

    ``preview`` is bounded in size; ``world_from_preview`` maps its pixels to the world.
    ``keyframe_outlines`` (K, 4, 2) and ``frame_outline`` (4, 2) are in world pixels.
    ``keyframes`` are the K names by which ``edges`` call them, 0 ... K-1 if none are given.
    """

    preview: Image
    world_from_preview: Matrix
    frame_outline: Points | None
    keyframe_outlines: Points
    edges: tuple[KeyframeEdge, ...] = field(default=())
    keyframes: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class PlacedFrame:
    """What became of one frame of a stream on the mosaic.

    ``state`` is ``placed``, ``refused`` or ``lost``, ``world_from_frame`` None unless placed;
    ``metrics`` are figures of this frame by name, finite.
    """

    index: int
    time_s: float
    size_wh: Size
    state: str
    world_from_frame: Matrix | None = None
    reason: str = ""
    metrics: Mapping[str, float] = field(default_factory=dict)
