"""The methods by name: streamtrack as its users run it, and the peers."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

from streamtrack.bench import peers, prewarp
from streamtrack.bench.follower import Follower
from streamtrack.errors import unknown_name
from streamtrack.pipeline import track
from streamtrack.settings import Settings, build_settings
from streamtrack.targets import Target
from streamtrack.types import Frame, Image, Points, Skipped, SourceInfo, Step

_RATE_HZ = 30.0


@dataclass(frozen=True, slots=True)
class Method:
    """One row of the benchmark. ``is_box``: it gives upright boxes, good for their centre only."""

    name: str
    title: str
    start: Callable[[Image, Points], Follower]
    parameters: Mapping[str, Any] = field(default_factory=dict)
    is_box: bool = False


class _Feed:
    """A source that yields the picture it was given last."""

    skipped: Sequence[Skipped] = ()
    corrupt_packets = 0
    shortfall = ""

    def __init__(self, image: Image) -> None:
        self.image = image
        self.info = SourceInfo("bench", (image.shape[1], image.shape[0]), _RATE_HZ, None)

    def __iter__(self) -> Iterator[Frame]:
        index = 0
        while True:
            yield Frame(index, index / _RATE_HZ, self.image)
            index += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        return None


class Streamtrack(Follower):
    """`streamtrack.track` with the pictures pushed in one by one."""

    def __init__(self, image: Image, quad: Points, settings: Settings) -> None:
        self._feed = _Feed(image)
        self._steps: Generator[Step] = track(self._feed, [Target("target", quad)], settings)
        next(self._steps)

    def update(self, image: Image) -> Points | None:
        self._feed.image = image
        step = next(self._steps)
        self.stage_ms = step.stage_ms
        return step.tracks[0].quad


def _streamtrack(name: str, title: str, values: dict[str, Any]) -> Method:
    settings = build_settings(values)
    parameters = settings.model_dump(mode="json", exclude={"recording"})
    return Method(
        name,
        title,
        lambda image, quad: Streamtrack(image, quad, settings),
        {"settings": parameters},
    )


def _detect(name: str, title: str, detector: str, descriptor: str) -> Method:
    features = {"detector": detector, "descriptor": descriptor}
    return _streamtrack(name, title, {"features": features, "tracker": {"method": "detect"}})


_ALL = (
    _streamtrack("streamtrack", "streamtrack", {}),
    _detect("harris-freak", "Harris + FREAK, every frame", "harris", "freak"),
    _detect("sift", "SIFT, every frame", "sift", "sift"),
    _detect("brisk", "BRISK, every frame", "brisk", "brisk"),
    Method(
        "plane-tracker",
        "OpenCV plane_tracker",
        peers.PlaneTracker,
        peers.PLANE_TRACKER_PARAMETERS,
    ),
    Method("lk-chain", "LK chain", peers.LucasKanadeChain, peers.CHAIN_PARAMETERS),
    Method("prewarp-lk", "Pre-warp LK", prewarp.PreWarpLK, prewarp.PARAMETERS),
    Method("prewarp-dis", "Pre-warp DIS", prewarp.PreWarpDIS, prewarp.PARAMETERS),
    Method("csrt", "CSRT, box", peers.csrt, {"parameters": "OpenCV's defaults"}, is_box=True),
    Method("kcf", "KCF, box", peers.kcf, {"parameters": "OpenCV's defaults"}, is_box=True),
)
METHODS: Mapping[str, Method] = {method.name: method for method in _ALL}
QUICK_METHODS = ("streamtrack", "plane-tracker", "lk-chain", "prewarp-lk")


def choose_methods(names: Sequence[str]) -> list[Method]:
    """The methods of these names, each once. Raises UsageError for a name that is none."""
    for name in names:
        if name not in METHODS:
            raise unknown_name("method", name, METHODS)
    return [METHODS[name] for name in dict.fromkeys(names)]
