"""The values that flow through streamtrack, and the conventions they keep.

Points      float32 (N, 2), x then y, in pixels; (0, 0) is the centre of the top-left pixel.
Images      uint8, (H, W, 3) in BGR order or (H, W) grey.
Sizes       (width, height).
Matrices    float64 (3, 3), named ``b_from_a``: p_b ~ b_from_a @ p_a. Names chain where they meet:
            ``world_from_cur = world_from_ref @ ref_from_cur``.
Quads       (4, 2): top-left, top-right, bottom-right, bottom-left of the target as it was first
            given, carried along with it (so they may come to lie anywhere).
Time        ``time_s``, seconds on the source's own clock (pts x time base), never index / fps.
World       the pixel frame of the first keyframe.

What is not known is ``None``, never a stale value.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

Image: TypeAlias = npt.NDArray[np.uint8]
Points: TypeAlias = npt.NDArray[np.float32]
Matrix: TypeAlias = npt.NDArray[np.float64]
Mask: TypeAlias = npt.NDArray[np.bool_]
Size: TypeAlias = tuple[int, int]


def _check_shape(name: str, array: npt.NDArray[np.generic], shape: tuple[int | None, ...]) -> None:
    """Raise ValueError unless ``array`` has ``shape``; None stands for any length."""
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join("_" if n is None else str(n) for n in shape) + ")"
        raise ValueError(f"{name} must have shape {wanted}, but has {array.shape}")


@dataclass(frozen=True, slots=True)
class Packet:
    """One encoded video packet as the source delivered it, ready to be stored elsewhere.

    H.264 and H.265 come as Annex B with parameter sets in the stream; MJPEG as one whole JPEG.
    """

    time_s: float
    data: bytes
    is_keyframe: bool


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One picture of a source.

    ``index`` counts the source's pictures from 0, those that were left out included.
    ``name`` is the file name for pictures and empty for video. ``packets`` are the encoded
    packets that arrived since the frame before, if the source was opened to deliver them.

    Live sources tell when the picture was captured: ``captured_s`` on `time.monotonic`'s clock and
    ``captured_unix_s`` as wall time. ``waited_s`` is how long this picture, or one that was dropped
    for it, lay ready while the caller was still busy: 0 if the caller keeps up. ``epoch`` counts
    how often the stream began anew: with it the view, the size and the colours may be others.
    """

    index: int
    time_s: float
    image: Image
    name: str = ""
    packets: tuple[Packet, ...] = ()
    captured_s: float | None = None
    captured_unix_s: float | None = None
    epoch: int = 0
    waited_s: float = 0.0

    def __post_init__(self) -> None:
        if self.image.dtype != np.uint8 or not (
            self.image.ndim == 2 or (self.image.ndim == 3 and self.image.shape[2] == 3)
        ):
            raise ValueError(
                "image must be uint8 with shape (_, _) or (_, _, 3), "
                f"but is {self.image.dtype} with {self.image.shape}"
            )

    @property
    def size_wh(self) -> Size:
        """(width, height) in pixels."""
        return self.image.shape[1], self.image.shape[0]


@dataclass(frozen=True, slots=True)
class Skipped:
    """One picture that a source left out, and why."""

    index: int
    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class SourceInfo:
    """What a source says of itself once it is open.

    ``rate_hz`` is the nominal rate, None if the header has none; ``frame_count`` is None if
    unknown or endless. ``packet_codec`` names the codec of ``Frame.packets`` (``h264``, ``hevc``,
    ``av1``, ``vp8``, ``vp9``, ``mjpeg``) and is None if frames carry no packets. ``asset_path``
    is an MP4 file that can be embedded whole because its packets cannot be copied one by one
    (B-frames); frame times of the source and of the file are the same.
    """

    uri: str
    size_wh: Size
    rate_hz: float | None
    frame_count: int | None
    is_live: bool = False
    packet_codec: str | None = None
    asset_path: Path | None = None

    @property
    def name(self) -> str:
        """A short name for messages and default file names: no folder, no credentials."""
        if "://" in self.uri:
            scheme, _, rest = self.uri.partition("://")
            host = rest.partition("?")[0].rpartition("@")[2].strip("/")
            return f"{scheme}-{host.replace('/', '-')}"
        return Path(self.uri).name or self.uri


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Keypoints of one picture with their descriptors; row i of each array is keypoint i.

    points       float32 (N, 2), pixels of the full-resolution picture
    sizes        float32 (N,), diameter of the described neighbourhood's nominal keypoint, pixels
    responses    float32 (N,), the detector's own strength
    descriptors  uint8 (N, bytes) for binary descriptors, float32 (N, D) for SIFT
    """

    points: Points
    sizes: npt.NDArray[np.float32]
    responses: npt.NDArray[np.float32]
    descriptors: npt.NDArray[np.generic]

    def __post_init__(self) -> None:
        _check_shape("points", self.points, (None, 2))
        _check_shape("sizes", self.sizes, (len(self.points),))
        _check_shape("responses", self.responses, (len(self.points),))
        _check_shape("descriptors", self.descriptors, (len(self.points), None))

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: npt.NDArray[np.generic]) -> Features:
        """The features at ``rows``, a boolean mask (N,) or integer row numbers."""
        return Features(
            self.points[rows], self.sizes[rows], self.responses[rows], self.descriptors[rows]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Pairs of rows in two feature sets: ``ref`` (M,), ``cur`` (M,) int, ``distances`` (M,)."""

    ref: npt.NDArray[np.intp]
    cur: npt.NDArray[np.intp]
    distances: npt.NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.ref)


class Model(StrEnum):
    """Transformation models, from few to many degrees of freedom (2, 4, 6, 8)."""

    TRANSLATION = "translation"
    SIMILARITY = "similarity"
    AFFINE = "affine"
    HOMOGRAPHY = "homography"


class Verdict(StrEnum):
    """What became of an estimate; everything but OK is a refusal."""

    OK = "ok"
    TOO_FEW_FEATURES = "too few features"
    TOO_FEW_MATCHES = "too few matches"
    TOO_FEW_INLIERS = "too few inliers"
    NOT_SPREAD = "inliers not spread over the target"
    MIRRORED = "mirrored or folded"
    NOT_CONVEX = "quad not convex"
    AREA = "area changed beyond belief"
    PERSPECTIVE = "perspective beyond belief"
    LOW_CORRELATION = "picture does not correlate with the target"
    OTHER_COLORS = "colours differ from the target's"
    MOSTLY_HIDDEN = "too little of the target in view to place its corners"
    NOT_SEARCHED = "not searched for in this frame, to keep to the time budget"
    OUT_OF_VIEW = "target out of view"
    UNCERTAIN = "corners too uncertain"
    AMBIGUOUS = "repeated texture, another place fits as well"
    OVERLAY = "only what stands still in both agrees: a stamp, a frame, dirt; the rest differs"
    STRETCHED = "frame would cover more than four times its area"


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """A gated estimate of how picture a maps to picture b.

    ``b_from_a`` and ``model`` are None unless the verdict is OK; ``is_inlier`` (M,) tells which of
    the M given pairs agree; ``rmse_px`` is the inliers' RMS transfer error in b, or NaN.
    """

    verdict: Verdict
    b_from_a: Matrix | None
    model: Model | None
    is_inlier: Mask
    rmse_px: float

    @property
    def inliers(self) -> int:
        return int(np.count_nonzero(self.is_inlier))


class TrackState(StrEnum):
    """State of one target in one frame."""

    SEARCHING = "searching"
    """Not seen since the start."""
    TRACKING = "tracking"
    LOST = "lost"


def _no_points() -> Points:
    return np.zeros((0, 2), np.float32)


def _no_mask() -> Mask:
    return np.zeros(0, np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """The point pairs on which a track's estimate rests.

    template_points   float32 (M, 2), pixels of the picture in which the target was given
    frame_points      float32 (M, 2), where they were found in this frame
    is_inlier         bool (M,), agrees with the estimate
    unmatched_points  float32 (K, 2), features of this frame, or template points carried into
                      it, that found no partner
    """

    template_points: Points = field(default_factory=_no_points)
    frame_points: Points = field(default_factory=_no_points)
    is_inlier: Mask = field(default_factory=_no_mask)
    unmatched_points: Points = field(default_factory=_no_points)

    def __post_init__(self) -> None:
        _check_shape("template_points", self.template_points, (None, 2))
        _check_shape("frame_points", self.frame_points, (len(self.template_points), 2))
        _check_shape("is_inlier", self.is_inlier, (len(self.template_points),))
        _check_shape("unmatched_points", self.unmatched_points, (None, 2))

    def __len__(self) -> int:
        return len(self.template_points)

    @property
    def inliers(self) -> int:
        return int(np.count_nonzero(self.is_inlier))


class _Path(Protocol):
    """The positions of one target."""

    def points(self, last_frame: int) -> Points:
        """Those up to a frame, float32 (N, 2), where they lie by what is known now."""


@dataclass(frozen=True, slots=True, eq=False)
class GroundPlace:
    """A target on the ground: ``position`` (2,), and its speed, None if unknown, in units."""

    position: npt.NDArray[np.float64]
    speed_units_s: float | None


@dataclass(frozen=True, slots=True, eq=False)
class WorldPlace:
    """Where a target is in the world, the pixel frame of the first keyframe.

    quad           float32 (4, 2), the corners in world pixels
    position       float64 (2,), where its diagonals cross
    velocity_px_s  float64 (2,), over the last half second (`mean_velocity`), None before frame 3
    sigma_px       expected RMS error of the corners in world pixels, the camera's own drift and
                   what the target's point pairs tell of it; NaN if the camera's is not known
    ground         its place in units, None without a scale or beyond the horizon
    """

    quad: Points
    position: npt.NDArray[np.float64]
    velocity_px_s: npt.NDArray[np.float64] | None
    sigma_px: float
    ground: GroundPlace | None
    _path: _Path
    _frame: int

    @property
    def speed_px_s(self) -> float | None:
        """World pixels a second."""
        velocity = self.velocity_px_s
        return None if velocity is None else float(np.hypot(*velocity))

    @property
    def path(self) -> Points:
        """Its positions up to this frame, float32 (N, 2), oldest first, by today's poses."""
        return self._path.points(self._frame)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One target in one frame.

    ``quad``, ``frame_from_template`` and ``model`` are None unless the state is TRACKING.
    Template pixels are those of the picture in which the target was given: the first frame,
    or the template picture. ``reason`` says in words why the target is not tracked, and is
    empty otherwise. ``means`` names the way the result was found (``flow``, ``view``, ``body``,
    ``guided``, ``global``, ``detect``); a ``body``, which is not flat, has no point pairs as
    evidence and no RMSE. ``correlation`` is the normalised cross-correlation of target and picture,
    or NaN. ``world`` is where it is in the world; None if that or the camera's pose is not known.
    ``is_found`` marks an automatic target: it was found by its motion (``means`` ``motion``, or
    ``carried`` where only its pixels' motion was seen) and may end any time.
    """

    name: str
    state: TrackState
    quad: Points | None = None
    frame_from_template: Matrix | None = None
    model: Model | None = None
    evidence: Evidence = field(default_factory=Evidence)
    rmse_px: float = float("nan")
    correlation: float = float("nan")
    means: str = ""
    reason: str = ""
    world: WorldPlace | None = None
    is_found: bool = False

    def __post_init__(self) -> None:
        is_tracking = self.state is TrackState.TRACKING
        if is_tracking != (self.quad is not None) or is_tracking != (
            self.frame_from_template is not None
        ):
            raise ValueError("quad and frame_from_template are given exactly while tracking")


AUTO_STAGE = "auto"
"""Key of `Step.stage_ms` that is there while automatic targets are looked for."""


class CameraKind(StrEnum):
    """What a camera does."""

    FIXED = "fixed"
    MOVING = "moving"


@dataclass(frozen=True, slots=True, eq=False)
class CameraPose:
    """Where the camera looks: ``world_from_frame`` is None if unknown, with the reason.

    ``matches`` and ``inliers`` count the places that were compared and that agree. ``keyframe`` is
    the index of the keyframe that the frame was measured against, the frame's own if it became
    one. ``sigma_px`` is the expected RMS error of the frame's corners in the world, in pixels of
    the first keyframe, NaN if it is not known. ``warning`` says what is wrong although the pose is
    given: a fixed camera that was moved.
    ``kind`` is what `--camera auto` takes the camera for in this frame, None if it was told.
    ``overlay`` are quads (4, 2) in the frame that lie over every picture: bars, text, a bonnet.
    """

    world_from_frame: Matrix | None
    matches: int = 0
    inliers: int = 0
    rmse_px: float = float("nan")
    reason: str = ""
    keyframe: int | None = None
    is_keyframe: bool = False
    warning: str = ""
    kind: CameraKind | None = None
    sigma_px: float = float("nan")
    overlay: tuple[Points, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """All that one frame produced.

    ``features`` are the frame's own keypoints if any were detected in it (following a target
    by flow needs none). ``stage_ms`` maps the stages that ran to wall milliseconds, ``total``
    among them. ``work_level`` says by how many steps (`streamtrack.budget`) work was lowered.
    """

    frame: Frame
    tracks: tuple[Track, ...]
    camera: CameraPose
    features: Features | None
    stage_ms: dict[str, float]
    work_level: int = 0
