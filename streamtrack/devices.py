"""The cameras of this machine: what they are called, what they offer and how to address them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from streamtrack.sources.v4l2.choice import Wanted, choose, rate_to_ask
from streamtrack.sources.v4l2.controls import ControlInfo, list_controls
from streamtrack.sources.v4l2.formats import (
    FORMATS,
    Mode,
    NodeKind,
    describe,
    node_paths,
    offered_formats,
    opened,
    read_modes,
    stable_paths,
)
from streamtrack.sources.v4l2.trouble import trouble
from streamtrack.sources.v4l2.uri import uri_of
from streamtrack.types import Size

__all__ = ["Device", "Mode", "find_devices", "sizes_and_rates", "to_json"]


@dataclass(frozen=True, slots=True)
class Device:
    """One camera.

    ``stable_path`` stays the same when devices are plugged in another order; None if udev made
    none. ``uri`` asks for what is read by default. ``modes`` are those that can be read, and
    ``unreadable_formats`` the fourccs of the others. ``problem`` says why it cannot be opened, and
    is empty if it can; formats and controls are known only then.
    """

    path: str
    stable_path: str | None
    name: str
    driver: str = ""
    bus: str = ""
    modes: tuple[Mode, ...] = ()
    unreadable_formats: tuple[str, ...] = ()
    controls: tuple[ControlInfo, ...] = ()
    uri: str = ""
    problem: str = ""


def find_devices() -> list[Device]:
    """All nodes that capture pictures, in the order of their numbers.

    Metadata, output and converter nodes are left out. Nothing is changed on any device.
    """
    links = stable_paths()
    found = (_device(path, links.get(os.path.realpath(path))) for path in node_paths())
    return [device for device in found if device is not None]


def _device(path: str, stable_path: str | None) -> Device | None:
    """None if the node is no camera, or is gone again."""
    shown_path = stable_path or path
    try:
        with opened(path) as fd:
            node = describe(fd, path)
            if node.kind is not NodeKind.CAPTURE or not node.is_streaming:
                return None
            formats = offered_formats(fd, node)
            modes = read_modes(fd, filter(FORMATS.__contains__, formats))
            controls = tuple(list_controls(fd).values())
    except OSError as error:
        if not _may_be_a_camera(path):
            return None
        uri = f"v4l2://{shown_path}"
        return Device(
            path, stable_path, _system_name(path), uri=uri, problem=str(trouble(path, error))
        )
    unreadable = tuple(fourcc for fourcc in formats if fourcc not in FORMATS)
    uri = f"v4l2://{shown_path}"
    problem = ""
    best = choose(modes, Wanted())
    if best is not None:
        uri = uri_of(shown_path, best.size_wh, rate_to_ask(best, Wanted()), best.fourcc)
    else:
        problem = "it offers no format that can be read"
    return Device(
        *(path, stable_path, node.name, node.driver, node.bus),
        *(modes, unreadable, controls, uri, problem),
    )


def _may_be_a_camera(path: str) -> bool:
    """Of a node that cannot be asked: the first node of a device is the one that captures."""
    return Path(path).exists() and _system_text(path, "index") in ("0", "")


def _system_name(path: str) -> str:
    return _system_text(path, "name") or "unknown"


def _system_text(path: str, leaf: str) -> str:
    try:
        file = Path("/sys/class/video4linux", Path(path).name, leaf)
        return " ".join(file.read_text(encoding="utf-8", errors="replace").split())
    except OSError:
        return ""


def sizes_and_rates(device: Device) -> list[tuple[str, str, str]]:
    """(format, size, rates in Hz) in words, largest sizes first; ranges of sizes in one row."""
    rows: list[tuple[str, str, str]] = []
    for fourcc, name in FORMATS.items():
        modes = sorted((m for m in device.modes if m.fourcc == fourcc), key=_area, reverse=True)
        ranged = [mode for mode in modes if mode.is_ranged]
        if ranged:
            largest, least = ranged[0], ranged[-1]
            any_size = f"{_size(least.size_wh)} to {_size(largest.size_wh)}"
            rows.append((name, any_size, f"{largest.rates}" or "not told"))
        rows.extend(
            (name, _size(mode.size_wh), str(mode.rates) or "not told")
            for mode in modes
            if not mode.is_ranged
        )
    return rows


def _area(mode: Mode) -> int:
    return mode.size_wh[0] * mode.size_wh[1]


def _size(size_wh: Size) -> str:
    return f"{size_wh[0]}x{size_wh[1]}"


def to_json(devices: Sequence[Device]) -> dict[str, Any]:
    """Plain values of all there is to know; ``fps`` are rates, or the ends of a range of them."""
    return {
        "devices": [
            {
                "path": device.path,
                "stable_path": device.stable_path,
                "name": device.name,
                "driver": device.driver,
                "bus": device.bus,
                "uri": device.uri,
                "problem": device.problem or None,
                "modes": [
                    {
                        "format": FORMATS[mode.fourcc],
                        "fourcc": mode.fourcc,
                        "width": mode.size_wh[0],
                        "height": mode.size_wh[1],
                        "fps": [round(rate, 3) for rate in mode.rates.values],
                        "fps_is_range": mode.rates.is_range,
                        "size_is_of_range": mode.is_ranged,
                    }
                    for mode in device.modes
                ],
                "unreadable_formats": list(device.unreadable_formats),
                "controls": [
                    {
                        "name": control.name,
                        "default": control.default,
                        "low": control.low,
                        "high": control.high,
                        "step": control.step,
                        "items": {str(value): item for value, item in control.items.items()},
                        "is_inactive": control.is_inactive,
                    }
                    for control in device.controls
                ],
            }
            for device in devices
        ]
    }
