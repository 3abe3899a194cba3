"""A run of streamtrack on an emulated camera, watched from outside; used by the scripts here.

The camera shows a circuit board moving to and fro (``synthetic://board``), and is the one of the
tests (tests/v4l2_emulator.py): it needs a C compiler, and Linux.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import cv2

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

from v4l2_emulator import MOST_FRAMES, EmulatedCamera, Emulator  # noqa: E402

from streamtrack.sources.synthetic import SyntheticSource  # noqa: E402

VGA = "MJPG 640 480 30"
PAGE = os.sysconf("SC_PAGE_SIZE")
WAIT_S = 60.0


@dataclass(frozen=True)
class Scene:
    """What the camera shows, and where to find the target in it."""

    camera: EmulatedCamera
    emulator: Emulator
    target: str


def make_scene(folder: Path, modes: Sequence[str] = (VGA,)) -> Scene:
    """A camera /dev/video40 and a template picture of its target, in a new folder."""
    source = SyntheticSource(f"synthetic://board?size=640x480&frames={MOST_FRAMES // 2}&seed=3")
    there = [source.frame(index).image for index in range(MOST_FRAMES // 2)]
    emulator = Emulator(folder)
    camera = emulator.add(40, modes, pictures=[*there, *reversed(there)])
    template = folder / "board.png"
    cv2.imwrite(str(template), there[0])
    quad = ",".join(f"{value:.1f}" for value in source.truth(0).quad.ravel())
    return Scene(camera, emulator, f"board={template}@{quad}")


@dataclass(frozen=True)
class Sample:
    """What the process and its children hold, at a moment."""

    at_s: float
    rss_mb: float
    files: int
    threads: int
    children: int
    children_rss_mb: float


class TrackerProcess:
    """`streamtrack track` as a child; what it prints is in ``folder``/stdout and stderr."""

    def __init__(
        self, folder: Path, arguments: Sequence[str], env: dict[str, str] | None = None
    ) -> None:
        self.folder = folder
        self.summary_path = folder / "summary.json"
        self.began_s = time.monotonic()
        command = [sys.executable, "-m", "streamtrack.cli", "track", *arguments]
        with (folder / "stdout").open("wb") as out, (folder / "stderr").open("wb") as err:
            self.process = subprocess.Popen(
                [*command, "--summary", str(self.summary_path)],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                cwd=folder,
                env={**(os.environ if env is None else env), "PYTHONPATH": str(ROOT)},
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()

    def sample(self) -> Sample | None:
        """None once it has ended."""
        pid = self.process.pid
        if self.process.poll() is not None:
            return None
        children = _descendants(pid)
        return Sample(
            time.monotonic() - self.began_s,
            _rss_mb(pid),
            sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir()),
            sum(1 for _ in Path(f"/proc/{pid}/task").iterdir()),
            len(children),
            sum(_rss_mb(child) for child in children),
        )

    def stop(self, number: int = signal.SIGTERM, timeout_s: float = 30.0) -> float:
        """Ask it to end; the seconds that took."""
        began = time.monotonic()
        self.process.send_signal(number)
        self.process.wait(timeout_s)
        return time.monotonic() - began

    def summary(self) -> dict[str, Any]:
        return dict(json.loads(self.summary_path.read_text()))

    def cpu_s(self) -> float:
        """Seconds of processor time so far, children's not included."""
        return _cpu_s(self.process.pid)


class Run:
    """A watched run as a child, and all the lines it told so far."""

    def __init__(self, folder: Path, env: dict[str, str] | None = None, **given: Any) -> None:
        self.lines: list[dict[str, Any]] = []
        self.process = subprocess.Popen(
            [sys.executable, str(ROOT / "scripts" / "watched_run.py"), json.dumps(given)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            cwd=folder,
            env={**(env or os.environ), "PYTHONPATH": str(ROOT)},
            text=True,
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *exc: object) -> None:
        self.process.kill()
        self.process.wait()
        self._thread.join()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for text in self.process.stdout:
            self.lines.append(json.loads(text))

    def of(self, kind: str, since: float = 0.0) -> list[dict[str, Any]]:
        return [line for line in list(self.lines) if line["kind"] == kind and line["t"] >= since]

    def wait(self, is_so: Callable[[], Any], what: str, timeout_s: float = WAIT_S) -> Any:
        end_s = time.monotonic() + timeout_s
        while not (found := is_so()):
            if time.monotonic() > end_s or self.process.poll() is not None:
                raise AssertionError(
                    f"no {what}: {[ln for ln in self.lines if ln['kind'] != 'frame'][-8:]}"
                )
            time.sleep(0.01)
        return found

    def settle(self, frames: int = 60) -> None:
        since = time.time()
        self.wait(lambda: len(self.of("frame", since)) >= frames, f"{frames} frames")

    def said(self, words: str, since: float) -> dict[str, Any] | None:
        return next((line for line in self.of("log", since) if words in line["text"]), None)

    def rss_mb(self) -> float:
        return _rss_mb(self.process.pid)

    def cpu_s(self) -> float:
        return _cpu_s(self.process.pid)

    def stop(self) -> float:
        """SIGTERM; the seconds to its end."""
        began = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(30)
        took_s = time.monotonic() - began
        self._thread.join()
        return took_s


def _rss_mb(pid: int) -> float:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 1e6
    except (OSError, IndexError):
        return 0.0


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _descendants(pid: int) -> list[int]:
    found: list[int] = []
    waiting = [pid]
    while waiting:
        parent = waiting.pop()
        for path in Path(f"/proc/{parent}/task").glob("*/children"):
            try:
                children = [int(text) for text in path.read_text().split()]
            except OSError:
                continue
            found += children
            waiting += children
    return found
