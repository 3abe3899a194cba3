"""Do the points that were seen place the target's corners, those that were not seen among them?"""

from __future__ import annotations

import numpy as np

from streamtrack import geometry
from streamtrack.types import Evidence, Matrix, Model, Points
from streamtrack.uncertainty import target_sigma_px

MAX_SIGMA_FOLLOWED_PX = 6.0
"""RMS over the corners, of a target that was followed to where it is."""
MAX_SIGMA_FOUND_PX = 3.0
"""Of one that was found anew."""
_USUAL_SIZE_PX = 400.0  # larger targets may be less certain in proportion


def are_corners_certain(
    pose: Matrix, model: Model, evidence: Evidence, quad: Points, most_px: float
) -> bool:
    """Is ``pose`` (frame_from_template) good enough at the corners ``quad`` (4, 2) to be told?

    What motion lets expect of hidden corners is no evidence here: it is what goes wrong unnoticed.
    ``model`` says by how many freedoms the corners may be off.
    """
    area_px = abs(geometry.signed_area(geometry.transform_points(pose, quad)))
    size = max(1.0, float(np.sqrt(area_px)) / _USUAL_SIZE_PX)
    return target_sigma_px(pose, model, evidence, quad) <= most_px * size
