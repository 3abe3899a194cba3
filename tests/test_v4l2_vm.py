"""The V4L2 reader on real kernel devices: ``scripts/test -m vm``, as root on Debian 12."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent.parent / "scripts" / "v4l2_vm"


@pytest.mark.vm
@pytest.mark.slow
def test_all_checks_pass_on_vivid_and_v4l2loopback(tmp_path: Path) -> None:
    report = tmp_path / "report.md"
    done = subprocess.run([SCRIPT, report], capture_output=True, text=True)
    assert done.returncode == 0, report.read_text() if report.exists() else done.stderr[-3000:]
    assert report.read_text().endswith("All passed.\n")
