"""Two pictures against a true homography: recall, precision and corner error."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from streamtrack.errors import SourceError
from streamtrack.mosaic.types import Link, Picture
from streamtrack.types import Matrix


def read_truth(path: Path) -> Matrix:
    """The homography (3, 3) of a text file with nine numbers. Raises SourceError."""
    try:
        cells = path.read_text(encoding="ascii").replace(",", " ").split()
        numbers = np.array([float(cell) for cell in cells])
    except OSError as error:
        raise SourceError(f"cannot read the truth {path}: {error.strerror}") from None
    except ValueError:
        raise SourceError(f"the truth {path} is no text of numbers") from None
    if numbers.shape != (9,):
        raise SourceError(f"the truth {path} must hold 9 numbers, but holds {len(numbers)}")
    if not np.all(np.isfinite(numbers)):
        raise SourceError(f"the truth {path} holds numbers that are not finite")
    matrix: Matrix = numbers.reshape(3, 3)
    if abs(np.linalg.det(matrix)) < 1e-12:
        raise SourceError(f"the truth {path} is no mapping: its determinant is 0")
    return matrix


def measured_against(
    true_b_from_a: Matrix, link: Link, a: Picture, b: Picture, threshold_px: float
) -> dict[str, float]:
    """Recall, 1 - precision and corner error of one link, in px of the registered pictures."""
    from streamtrack.evaluation import corner_error, recall_precision

    pairs = np.column_stack([link.matches.ref, link.matches.cur])
    found = recall_precision(
        a.features.points, b.features.points, pairs, true_b_from_a, threshold_px
    )
    measured = {"recall": found.recall, "one_minus_precision": 1 - found.precision}
    if link.b_from_a is not None:
        measured["corner_error_px"] = corner_error(link.b_from_a, true_b_from_a, a.size_wh)
    return measured
