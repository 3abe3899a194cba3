"""A camera's controls: exposure, gain, focus and the rest, by name."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from streamtrack.errors import SourceError, UsageError, unknown_name
from streamtrack.sources.v4l2 import api

_log = logging.getLogger("streamtrack.sources")

_MOST_CONTROLS = 512
_KINDS = {
    api.CTRL_INTEGER: "integer",
    api.CTRL_BOOLEAN: "on or off",
    api.CTRL_MENU: "menu",
    api.CTRL_INTEGER_MENU: "menu",
}
_SWITCHES = {"on": 1, "true": 1, "yes": 1, "off": 0, "false": 0, "no": 0}
# Linux 5.18 renamed the controls of cameras; both names, and the plain word, find them.
_OTHER_NAMES = {
    "exposure_auto": 0x009A0901,
    "auto_exposure": 0x009A0901,
    "exposure": 0x009A0902,
    "exposure_absolute": 0x009A0902,
    "exposure_time_absolute": 0x009A0902,
    "exposure_auto_priority": 0x009A0903,
    "exposure_dynamic_framerate": 0x009A0903,
    "focus": 0x009A090A,
    "focus_absolute": 0x009A090A,
    "focus_auto": 0x009A090C,
    "focus_automatic_continuous": 0x009A090C,
    "zoom": 0x009A090D,
    "white_balance_temperature_auto": 0x0098090C,
    "white_balance_automatic": 0x0098090C,
}


@dataclass(frozen=True, slots=True)
class ControlInfo:
    """One control; ``items`` are the entries of a menu by their values."""

    id: int
    name: str
    type: int
    low: int
    high: int
    step: int
    default: int
    is_inactive: bool
    items: Mapping[int, str]

    @property
    def choices(self) -> str:
        """What may be set, for messages."""
        if self.items:
            return ", ".join(f"{value} ({item})" for value, item in self.items.items())
        if self.type == api.CTRL_BOOLEAN:
            return "on, off"
        return f"{self.low}..{self.high}" + (f" by {self.step}" if self.step > 1 else "")


def list_controls(fd: int) -> dict[str, ControlInfo]:
    """The controls that can be set, by name as v4l2-ctl writes it. Raises OSError."""
    controls: dict[str, ControlInfo] = {}
    asked = api.QueryControl(id=api.CTRL_FLAG_NEXT)
    for _ in range(_MOST_CONTROLS):
        if not api.is_offered(fd, api.QUERYCTRL, asked):
            break
        if asked.type in _KINDS and not asked.flags & (
            api.CTRL_FLAG_DISABLED | api.CTRL_FLAG_READ_ONLY
        ):
            info = _info(fd, asked)
            controls[info.name] = info
        asked = api.QueryControl(id=asked.id | api.CTRL_FLAG_NEXT)
    return controls


def _info(fd: int, found: api.QueryControl) -> ControlInfo:
    items: dict[int, str] = {}
    if found.type in (api.CTRL_MENU, api.CTRL_INTEGER_MENU):
        for index in range(found.minimum, min(found.maximum, found.minimum + 255) + 1):
            item = api.QueryMenu(id=found.id, index=index)
            if not api.is_offered(fd, api.QUERYMENU, item):
                continue  # a hole in the menu
            raw = bytes(item.name)
            if found.type == api.CTRL_MENU:
                items[index] = api.text_of(raw.partition(b"\0")[0])
            else:
                items[index] = str(int.from_bytes(raw[:8], "little", signed=True))
    return ControlInfo(
        found.id,
        plain_name(api.text_of(found.name)),
        found.type,
        found.minimum,
        found.maximum,
        found.step,
        found.default_value,
        bool(found.flags & api.CTRL_FLAG_INACTIVE),
        items,
    )


def plain_name(text: str) -> str:
    """``Exposure Time, Absolute`` -> ``exposure_time_absolute``."""
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")


def set_controls(fd: int, path: str, wanted: Sequence[tuple[str, str]]) -> None:
    """Set them, switches before numbers, since an automatic must be off for its value to count.

    What the driver sets otherwise than asked is logged. Raises UsageError for names and values
    that the device does not have, SourceError if it refuses, OSError if it is gone.
    """
    if not wanted:
        return
    known = list_controls(fd)
    asked = [(control := _find(known, path, name), _value(control, text)) for name, text in wanted]
    for control, value in sorted(asked, key=lambda pair: pair[0].type == api.CTRL_INTEGER):
        _set(fd, path, control, value)


def _find(known: Mapping[str, ControlInfo], path: str, name: str) -> ControlInfo:
    if not known:
        raise UsageError(f"{path} has no controls: leave out control.{name}")
    plain = plain_name(name)
    if plain in known:
        return known[plain]
    by_id = {control.id: control for control in known.values()}
    same = by_id.get(_OTHER_NAMES.get(plain, -1))
    if same is None:
        raise unknown_name(f"control of {path}", name, known)
    return same


def _value(control: ControlInfo, text: str) -> int:
    value = _number(control, text)
    is_known = value in control.items if control.items else control.low <= value <= control.high
    if not is_known:
        raise UsageError(f"control.{control.name}={text} cannot be right: give {control.choices}")
    return value


def _number(control: ControlInfo, text: str) -> int:
    word = plain_name(text)
    if control.type == api.CTRL_BOOLEAN and word in _SWITCHES:
        return _SWITCHES[word]
    for value, item in control.items.items():
        # A menu of integers shows what its entries stand for: that is what people write.
        if word == plain_name(item):
            return value
    try:
        return int(text)
    except ValueError:
        return control.high + 1


def _set(fd: int, path: str, control: ControlInfo, value: int) -> None:
    answer = api.Control(id=control.id, value=value)
    try:
        api.ioctl(fd, api.S_CTRL, answer)
    except OSError as error:
        # Asked again: setting the others may have changed it.
        now = list_controls(fd).get(control.name, control)
        refusal = f"{path} refuses control.{control.name}={value}"
        if now.is_inactive:
            raise UsageError(
                f"{refusal}, which an automatic controls: switch that off too, as "
                "control.auto_exposure=1 or control.focus_auto=off"
            ) from None
        raise SourceError(f"{refusal}: {error.strerror or error}") from None
    read = api.Control(id=control.id)
    if api.is_offered(fd, api.G_CTRL, read) and read.value != value:
        _log.warning(
            "%s: asked for %s %d, the device set %d", path, control.name, value, read.value
        )
