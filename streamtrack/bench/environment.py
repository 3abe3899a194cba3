"""With what a benchmark was run."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from typing import Any

_PACKAGES = ("streamtrack", "numpy", "opencv-contrib-python-headless", "av")


def environment() -> dict[str, Any]:
    """Versions of Python and packages, and the machine, for a report."""
    return {
        "versions": {
            "python": platform.python_version(),
            **{package: version(package) for package in _PACKAGES},
        },
        "machine": {
            "system": platform.system(),
            "architecture": platform.machine(),
            "cores": os.cpu_count(),
            "opencv_threads": 1,
        },
    }
