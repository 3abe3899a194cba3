"""Direct alignment of two views of one scene: which mapping makes their grey values agree?

Inverse compositional Gauss-Newton (Baker & Matthews 2004, section 3.2) over the most textured
pixels of every part of a keyframe, from coarse to fine and from a similarity to a homography. It
reads a few thousand pixels of the other view and nothing else, so it costs little, and it weighs
every pixel by its gradient, which makes it several times as exact as matched points where texture
is weak. Light that changes smoothly drops out by a high-pass filter and a gain, moving things by
Tukey's biweight.

The outcome is judged cell by cell (see `view_verdict`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.camera.view_levels import (
    EDGE_PX,
    EXACT,
    USUAL,
    Floats,
    Pixels,
    ReferenceView,
    ViewLevels,
    fill,
    filled,
)
from streamtrack.camera.view_verdict import Fitted, ViewAlignment, judged, refusal
from streamtrack.fitting import solved, step_matrix
from streamtrack.registration import judge_mapping
from streamtrack.types import Image, Matrix, Model, Points, Verdict
from streamtrack.uncertainty import MODEL_BASES

Doubles: TypeAlias = npt.NDArray[np.float64]

_LEAST_PIXELS = (1000, 250, 60, 30, 20)  # in view, by level
_ROUNDS = (6, 8, 4, 4, 4)  # at most, by level
_SAME_PX = 0.5  # of a level: starts that differ by no more lead to the same end
_MAX_LAST_STEP_PX = 1.0  # of a fit that counts as converged
_CONVERGED_PX = 0.04  # what a further step would still move is about a tenth of it
_CONVERGED_COARSE_PX = 0.15
_PERSPECTIVE_SIGMA = 0.05  # of the change against the guess, in units of half a view
_SHAPE_SIGMA = 0.15
_MIN_SHAPE_SHARE = 0.6  # of agreeing cells, for a mapping richer than a similarity
_MIN_STIFF_SHARE = 0.85  # of its agreeing cells that a similarity must keep
_MAX_STIFF_UNLIKE = 1.25  # and the factor by which they may be less alike
_SHORT_PX = 0.5  # of the usual level: a step that needs no coarser level before it
_SHORT_END = 0.2  # and how much shorter the last step must be
_SEARCH_SHARE = 0.3  # of the view: how far the search for a shift reaches

_LONGEST_ROW = 32_000

_SIMILARITY, _AFFINE = MODEL_BASES[Model.SIMILARITY], MODEL_BASES[Model.AFFINE]
_FREEDOMS = (np.eye(8), np.eye(8), _AFFINE, _SIMILARITY, _SIMILARITY)  # by level


def align(
    reference: ReferenceView,
    view: ViewLevels,
    guess: Matrix,
    hidden: Sequence[Points] = (),
    *,
    is_searched: bool = False,
) -> ViewAlignment:
    """The mapping near ``guess`` (reference_from_view) that makes the views agree, judged.

    ``hidden`` are quads (4, 2) in the view that do not belong to the scene. ``is_searched`` looks
    for a shift first, as far as a third of the view, for guesses that may be far off.
    """
    try:
        view_from_reference = geometry.inverted(guess)
    except np.linalg.LinAlgError:
        return refusal(Verdict.MIRRORED)
    if judge_mapping(view_from_reference, geometry.image_quad(reference.size_wh)) is not Verdict.OK:
        return refusal(Verdict.PERSPECTIVE)
    if is_searched:
        view_from_reference = _shifted(reference, view, view_from_reference, hidden)
    coarsest = min(len(reference.levels.images), len(view.images)) - 1
    return _descended(reference, view, view_from_reference, hidden, coarsest)


def align_near(
    reference: ReferenceView, view: ViewLevels, guess: Matrix, hidden: Sequence[Points] = ()
) -> ViewAlignment:
    """As `align`, from a guess that is right to a few pixels: without the coarser levels.

    At the usual level alone if its steps are short.
    """
    try:
        start = geometry.inverted(guess)
    except np.linalg.LinAlgError:
        return refusal(Verdict.MIRRORED)
    fitted = _fit(reference, view, USUAL, start, hidden, most_px=_SHORT_PX)
    if fitted is not None:
        return _stiffened(reference, view, start, fitted, hidden)
    coarsest = min(USUAL + 1, len(reference.levels.images) - 1, len(view.images) - 1)
    return _descended(reference, view, start, hidden, coarsest)


def _descended(
    reference: ReferenceView,
    view: ViewLevels,
    start: Matrix,
    hidden: Sequence[Points],
    coarsest: int,
) -> ViewAlignment:
    """The fit from level to level, the coarsest first, judged; ``start`` is view_from_reference."""
    fitted: Fitted | None = None
    view_from_reference = start
    for level in range(coarsest, USUAL - 1, -1):
        if fitted is not None and _differ(view_from_reference, start, view, level):
            # Coarse levels may lead astray where texture is fine or weak.
            tried = (view_from_reference, start)
            view_from_reference = max(tried, key=lambda m: _likeness(reference, view, level, m))
        found = _fit(reference, view, level, view_from_reference, hidden)
        if found is not None:
            fitted, view_from_reference = found, found.view_from_reference
        elif level == USUAL:
            return refusal(Verdict.TOO_FEW_FEATURES if fitted is not None else Verdict.OUT_OF_VIEW)
        # Else what is hidden leaves too little of a coarse level: a finer one may hold enough.
    assert fitted is not None
    return _stiffened(reference, view, start, fitted, hidden)


def align_exactly(
    reference: ReferenceView, view: ViewLevels, guess: Matrix, hidden: Sequence[Points] = ()
) -> ViewAlignment:
    """As `align`, from a guess that is right to a pixel or two: more pixels, full resolution."""
    try:
        start = geometry.inverted(guess)
    except np.linalg.LinAlgError:
        return refusal(Verdict.MIRRORED)
    fitted = _fit(reference, view, EXACT, start, hidden)
    if fitted is None:
        return refusal(Verdict.TOO_FEW_FEATURES)
    return _stiffened(reference, view, start, fitted, hidden)


def _stiffened(
    reference: ReferenceView,
    view: ViewLevels,
    start: Matrix,
    fitted: Fitted,
    hidden: Sequence[Points],
) -> ViewAlignment:
    """The fit judged, or a similarity change of ``start`` where much of the view disagrees.

    What moves by itself (water, a herd) then cannot shear or tilt the rest.
    """
    found = judged(reference, view, fitted)
    agrees = found.inliers >= _MIN_SHAPE_SHARE * len(found.is_inlier)
    if found.verdict is not Verdict.OK or agrees:
        return found
    middle = geometry.image_quad(reference.size_wh).mean(axis=0, keepdims=True)
    before, after = (
        geometry.transform_points(m, middle)[0] for m in (start, fitted.view_from_reference)
    )
    near = geometry.translation(*(after - before).tolist()) @ start
    poorer = _fit(reference, view, fitted.level, near, hidden, _SIMILARITY)
    stiff = found if poorer is None else judged(reference, view, poorer)
    is_as_good = stiff.inliers >= _MIN_STIFF_SHARE * found.inliers
    is_as_good &= 1 - stiff.correlation <= _MAX_STIFF_UNLIKE * (1 - found.correlation)
    return stiff if stiff.verdict is Verdict.OK and is_as_good else found


def _shifted(
    reference: ReferenceView,
    view: ViewLevels,
    view_from_reference: Matrix,
    hidden: Sequence[Points],
) -> Matrix:
    """The guess after the shift under which the middle of the overlap correlates best.

    At the coarsest level: the view is warped as the guess has it, and the middle of the
    reference is looked for in it.
    """
    level = min(len(reference.levels.images), len(view.images)) - 1
    wanted = _shown(reference.levels, level, reference.hidden)
    height, width = wanted.shape
    to_reference, to_view = reference.levels.level_from_view(level), view.level_from_view(level)
    mapping = to_view @ view_from_reference @ geometry.inverted(to_reference)
    reach_x, reach_y = int(_SEARCH_SHARE * width), int(_SEARCH_SHARE * height)
    # A wider warp: what the reference's frame would see with a border all round.
    size = width + 2 * reach_x, height + 2 * reach_y
    wide = cv2.warpPerspective(
        _shown(view, level, hidden),
        mapping @ geometry.translation(-reach_x, -reach_y),
        size,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0.0,
    )
    quarter_x, quarter_y = width // 4, height // 4
    patch = wanted[quarter_y : height - quarter_y, quarter_x : width - quarter_x]
    around = wide[quarter_y : size[1] - quarter_y, quarter_x : size[0] - quarter_x]
    # Nothing correlates with the empty border, so weak overlaps do not win by chance.
    score = cv2.matchTemplate(
        np.asarray(around, np.float32), np.ascontiguousarray(patch), cv2.TM_CCORR
    )
    y, x = np.unravel_index(int(np.argmax(score)), score.shape)
    shift = geometry.translation(float(x) - reach_x, float(y) - reach_y)
    moved = geometry.inverted(to_view) @ mapping @ shift @ to_reference
    return geometry.normalized(moved)


def _shown(levels: ViewLevels, level: int, hidden: Sequence[Points]) -> Floats:
    """The high-passed level, empty where quads (4, 2) of the view hide the scene."""
    values = levels.high_passed(level)
    if not hidden:
        return values
    covered = filled(hidden, levels.level_from_view(level), values.shape)
    return np.where(covered, np.float32(0), values)


def _fit(
    reference: ReferenceView,
    view: ViewLevels,
    level: int,
    start: Matrix,
    hidden: Sequence[Points],
    basis: Doubles | None = None,
    most_px: float = np.inf,
) -> Fitted | None:
    """Gauss-Newton at one level from ``start`` (view_from_reference), or None.

    With ``most_px`` None also if a step is longer than that, in pixels of the level, or if the
    steps come to no end: the start was too far off for this level alone.
    """
    values = view.high_passed(level)
    to_reference, to_view = reference.levels.level_from_view(level), view.level_from_view(level)
    mapping = to_view @ start @ geometry.inverted(to_reference)
    pixels = _in_view(reference.pixels(level), mapping, _open(view, level, hidden))
    if len(pixels.values) < _LEAST_PIXELS[level]:
        return None
    basis = _FREEDOMS[level] if basis is None else basis
    is_full = basis.shape[1] == 8
    jacobian = pixels.jacobian if is_full else basis.T.astype(np.float32) @ pixels.jacobian
    unit, level_from_unit = pixels.unit_from_level, geometry.inverted(pixels.unit_from_level)
    unit_px = level_from_unit[0, 0]
    prior = basis.T @ _PRIOR @ basis
    change = np.zeros(basis.shape[1])
    seen, residual, normal, moved_px = pixels.values, pixels.values, prior, 0.0
    for _ in range(_ROUNDS[level]):
        seen = _sampled(values, mapping, pixels.points)
        residual, precisions = _residuals(pixels.values, seen)
        weighted = jacobian * precisions
        normal = (weighted @ jacobian.T).astype(np.float64) + prior
        gradient = (weighted @ residual).astype(np.float64) - prior @ change
        step = solved(normal, gradient)
        most = np.inf if step is None else float(np.abs(step).max())
        if step is None or not most < 0.5 or most * unit_px > most_px:
            return None
        change += step
        unit_step = step_matrix(basis @ step)
        mapping = mapping @ geometry.inverted(level_from_unit @ unit_step @ unit)
        moved_px = most * unit_px
        if moved_px < (_CONVERGED_PX if level <= USUAL else _CONVERGED_COARSE_PX):
            break
    if moved_px > most_px * _SHORT_END:
        return None
    found = geometry.inverted(to_view) @ mapping @ to_reference
    if not np.isfinite(found).all() or abs(found[2, 2]) < 1e-9:
        return None
    is_settled = moved_px <= _MAX_LAST_STEP_PX
    return Fitted(
        geometry.normalized(found), level, pixels, seen, residual, basis, normal, is_settled
    )


def _likeness(
    reference: ReferenceView, view: ViewLevels, level: int, view_from_reference: Matrix
) -> float:
    """Correlation of a level's pixels under a mapping, those out of view counting as unlike."""
    to_reference, to_view = reference.levels.level_from_view(level), view.level_from_view(level)
    mapping = to_view @ view_from_reference @ geometry.inverted(to_reference)
    pixels = reference.pixels(level)
    values = view.high_passed(level)
    x, y, depth = _projected(mapping, pixels.points[:, ::2])
    seen = _remapped(values, x, y, cv2.BORDER_CONSTANT)
    seen[depth <= 0] = 0
    wanted = pixels.values[::2]
    return float(wanted @ seen) / float(np.sqrt((wanted @ wanted) * (seen @ seen)) + 1.0)


def _differ(one: Matrix, other: Matrix, view: ViewLevels, level: int) -> bool:
    """Whether two mappings into a view differ by more than rounding, in pixels of a level."""
    corners = geometry.image_quad(view.size_wh)
    off = geometry.transform_points(one, corners) - geometry.transform_points(other, corners)
    level_px = view.size_wh[0] / view.images[level].shape[1]
    return not float(np.abs(off).max()) <= _SAME_PX * level_px


def _make_prior() -> Doubles:
    """Precisions of a change: shape and perspective seldom change much from view to view."""
    precisions = np.zeros((8, 8))
    precisions[6, 6] = precisions[7, 7] = _PERSPECTIVE_SIGMA**-2
    stretch = np.array([[1.0, 0, 0, 0, -1.0, 0, 0, 0], [0, 1.0, 0, 1.0, 0, 0, 0, 0]])
    return np.asarray(precisions + stretch.T @ stretch * _SHAPE_SIGMA**-2, np.float64)


_PRIOR = _make_prior()


def _open(view: ViewLevels, level: int, hidden: Sequence[Points]) -> Image:
    """Where (h, w) a level of a view tells something of the scene: 1, at its edge and elsewhere 0.

    ``hidden`` are quads (4, 2) in the view that do not belong to the scene.
    """
    shape, edge = view.images[level].shape, EDGE_PX[level]
    told = np.zeros(shape, np.uint8)
    told[edge : -edge - 1, edge : -edge - 1] = 1
    fill(told, hidden, view.level_from_view(level), 0)
    return told


def _in_view(pixels: Pixels, mapping: Matrix, told: Image) -> Pixels:
    """Those of the pixels that ``mapping`` takes to where a level of a view is 1 (h, w)."""
    x, y, depth = _projected(mapping, pixels.points)
    is_told = _remapped(told, x, y, cv2.BORDER_CONSTANT, cv2.INTER_NEAREST)
    rows = np.flatnonzero((depth > 0) & (is_told > 0))
    return pixels if len(rows) == len(x) else pixels.of(rows)


def _projected(mapping: Matrix, points: Floats) -> tuple[Floats, Floats, Floats]:
    """x, y and depth (N,) of points (3, N)."""
    moved = mapping.astype(np.float32) @ points
    with np.errstate(divide="ignore", invalid="ignore"):
        return moved[0] / moved[2], moved[1] / moved[2], moved[2]


def _sampled(values: Floats, mapping: Matrix, points: Floats) -> Floats:
    """Values (N,) at where ``mapping`` takes the points (3, N)."""
    x, y, _ = _projected(mapping, points)
    return _remapped(values, x, y, cv2.BORDER_REPLICATE)


def _remapped(
    values: Floats | Image, x: Floats, y: Floats, border: int, flag: int = cv2.INTER_LINEAR
) -> Floats:
    """Values (N,) at places (N,), in parts no longer than OpenCV takes a row."""
    parts = [
        cv2.remap(values, x[None, at], y[None, at], flag, borderMode=border)[0]
        for at in (slice(i, i + _LONGEST_ROW) for i in range(0, max(len(x), 1), _LONGEST_ROW))
    ]
    return np.asarray(parts[0] if len(parts) == 1 else np.concatenate(parts), np.float32)


def _residuals(wanted: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """What the view (N,) has more than wanted after a gain, and the precision of each: Tukey's
    weights over the noise squared."""
    gain = (_median_size(wanted) + 0.2) / (_median_size(seen) + 0.2)
    residual = np.float32(min(3.0, max(0.33, gain))) * seen - wanted
    noise = 1.4826 * _median_size(residual) + 0.3
    share = residual * np.float32(1 / (4.685 * noise))
    weights = np.maximum(np.float32(0), 1 - share * share)
    weights *= weights
    precisions: Floats = weights * np.float32(1 / noise**2)
    return residual, precisions


def _median_size(values: Floats) -> float:
    """Median of the absolute values, from every fifth of them."""
    sizes = np.abs(values[::5])
    middle = len(sizes) // 2
    sizes.partition(middle)
    return float(sizes[middle])
