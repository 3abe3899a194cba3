"""Do the points that were seen place the target's corners, those that were not seen among them?"""

from __future__ import annotations

import numpy as np

from streamtrack import geometry
from streamtrack.types import Evidence, Matrix, Model, Points
from streamtrack.uncertainty import corner_sigmas_px

_MAX_SIGMA_PX = 6.0  # RMS over the corners
_MAX_SIGMA_SHARE = 0.02  # of the target's size in the frame, if that is more
_LEAST_POINT_SIGMA_PX = 0.1


def are_corners_certain(pose: Matrix, model: Model, evidence: Evidence, quad: Points) -> bool:
    """Is ``pose`` (frame_from_template) good enough at the corners ``quad`` (4, 2) to be told?

    What motion lets expect of hidden corners is no evidence here: it is what goes wrong unnoticed.
    """
    seen = evidence.is_inlier
    sigmas_px = corner_sigmas_px(
        pose,
        model,
        evidence.template_points[seen],
        evidence.frame_points[seen],
        quad,
        _LEAST_POINT_SIGMA_PX,
    )
    area_px = abs(geometry.signed_area(geometry.transform_points(pose, quad)))
    most_px = max(_MAX_SIGMA_PX, _MAX_SIGMA_SHARE * float(np.sqrt(area_px)))
    return float(np.sqrt(np.mean(sigmas_px**2))) <= most_px
