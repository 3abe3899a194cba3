"""Running methods over sequences and measuring what that takes.

OpenCV works in one thread meanwhile. Time is that of the processor, for the whole process, and a
frame's own: the first frame, in which a method is set up, is measured apart.
"""

from __future__ import annotations

import gc
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from streamtrack.bench.follower import Follower
from streamtrack.bench.memory import PeakMemory
from streamtrack.bench.methods import Method
from streamtrack.bench.scenarios import Clip, Floats, Scenario, Truth
from streamtrack.errors import OutputError, TargetError
from streamtrack.sources import open_source
from streamtrack.sources.writer import VideoWriter
from streamtrack.types import Image, Points, Size

_RATE_HZ = 30.0
_WARM_UP_FRAMES = 2


@dataclass(frozen=True, slots=True, eq=False)
class Footage:
    """A sequence that was run: what it was, without its pictures.

    ``decode_ms`` (N,) is the time to read each frame from an H.264 file, None without an encoder.
    """

    name: str
    group: str
    factor: str
    seed: int | None
    texture: str
    size_wh: Size
    truth: Truth
    decode_ms: Floats | None


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One method on one sequence of N frames; element i of each is frame i.

    ``cpu_ms[0]`` is the set-up. ``stages_ms`` is each frame's processor time divided among its
    stages by their shares of its wall time, empty where a method does not tell. ``refusal`` says
    why a method would not begin; it then saw nothing.
    """

    method: Method
    footage: Footage
    quads: tuple[Points | None, ...]
    cpu_ms: Floats
    stages_ms: tuple[dict[str, float], ...]
    memory_mb: float | None
    refusal: str = ""


@dataclass(frozen=True, slots=True)
class Run:
    """Everything that was measured. ``is_whole``: nobody stopped it."""

    trials: tuple[Trial, ...]
    peak_rss_mb: float
    is_whole: bool


def run_bench(
    scenarios: Sequence[Scenario],
    methods: Sequence[Method],
    tell: Callable[[str], None] = lambda _line: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Run:
    """All methods on all sequences, one sequence after the other.

    When it is to stop, the sequence in work is left out. Raises SourceError.
    """
    trials: list[Trial] = []
    memory = PeakMemory()
    with one_thread():
        for number, scenario in enumerate(scenarios, start=1):
            began = time.perf_counter()
            clip = scenario.load()
            if number == 1:
                _warm_up(methods, clip)
            new = _run_sequence(scenario, clip, methods, memory, should_stop)
            if should_stop():
                return Run(tuple(trials), memory.process_mb, is_whole=False)
            trials += new
            spent_s = time.perf_counter() - began
            tell(f"{number} of {len(scenarios)}: {scenario.name} ({spent_s:.0f} s)")
    return Run(tuple(trials), memory.process_mb, is_whole=True)


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV in one thread, as it was before afterwards."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _warm_up(methods: Sequence[Method], clip: Clip) -> None:
    """What happens once in a process, such as loading code, is not to be measured."""
    first = Clip(clip.images[:_WARM_UP_FRAMES], clip.truth)
    for method in methods:
        _follow(method, first)


def _run_sequence(
    scenario: Scenario,
    clip: Clip,
    methods: Sequence[Method],
    memory: PeakMemory,
    should_stop: Callable[[], bool],
) -> list[Trial]:
    height, width = clip.images[0].shape[:2]
    footage = Footage(
        scenario.name,
        scenario.group,
        scenario.factor,
        scenario.seed,
        scenario.texture,
        (width, height),
        clip.truth,
        _decoding_ms(clip.images),
    )
    trials = []
    for method in methods:
        if should_stop():
            break
        gc.collect()
        with memory.growth() as growth:
            quads, cpu_ms, stages, refusal = _follow(method, clip, should_stop)
        trials.append(Trial(method, footage, quads, cpu_ms, stages, growth.mb, refusal))
    return trials


def _follow(
    method: Method, clip: Clip, should_stop: Callable[[], bool] = lambda: False
) -> tuple[tuple[Points | None, ...], Floats, tuple[dict[str, float], ...], str]:
    """Quads, processor milliseconds and stages of every frame, and the refusal if there was one."""
    count = len(clip.images)
    cv2.setRNGSeed(1)
    began = time.process_time()
    try:
        follower = method.start(clip.images[0], clip.first_quad)
    except (TargetError, cv2.error) as error:
        nothing: tuple[Points | None, ...] = (None,) * count
        reason = str(error).splitlines()[0]
        return nothing, np.full(count, np.nan), ({},) * count, reason
    quads: list[Points | None] = [clip.first_quad]
    cpu_ms = [(time.process_time() - began) * 1e3]
    stages: list[dict[str, float]] = [{}]
    for image in clip.images[1:]:
        if should_stop():
            break
        began = time.process_time()
        quad = _update(follower, image)
        cpu_ms.append((time.process_time() - began) * 1e3)
        quads.append(quad)
        stages.append(_stages(cpu_ms[-1], follower))
    return tuple(quads), np.array(cpu_ms), tuple(stages), ""


def _update(follower: Follower, image: Image) -> Points | None:
    """A frame that a peer breaks on is a miss."""
    try:
        quad = follower.update(image)
    except (cv2.error, np.linalg.LinAlgError):
        return None
    return quad if quad is not None and bool(np.isfinite(quad).all()) else None


def _stages(cpu_ms: float, follower: Follower) -> dict[str, float]:
    wall_ms = dict(follower.stage_ms)
    total = wall_ms.pop("total", 0.0)
    if total <= 0:
        return {}
    stages = {name: cpu_ms * ms / total for name, ms in wall_ms.items()}
    return {**stages, "rest": max(cpu_ms - sum(stages.values()), 0.0)}


def _decoding_ms(images: Sequence[Image]) -> Floats | None:
    """Processor milliseconds to read each frame back from an H.264 file."""
    with tempfile.TemporaryDirectory(prefix="streamtrack-bench-") as folder:
        path = Path(folder) / "clip.mp4"
        try:
            with VideoWriter(path, rate_hz=_RATE_HZ) as writer:
                for index, image in enumerate(images):
                    writer.write(image, index / _RATE_HZ)
        except OutputError:
            return None
        spent: list[float] = []
        with open_source(path) as source:
            frames = iter(source)
            while True:
                began = time.process_time()
                if next(frames, None) is None:
                    break
                spent.append((time.process_time() - began) * 1e3)
    return np.array(spent) if len(spent) == len(images) else None
