"""What a run says of its camera: what it was found to be, and when, and what was wrong with it."""

from __future__ import annotations

from dataclasses import dataclass

from streamtrack.types import CameraKind, Step

_MOST_KEPT = 8


@dataclass(frozen=True, slots=True)
class CameraNote:
    """One thing to say of the camera; ``is_warning`` if what was asked for does not hold."""

    text: str
    is_warning: bool


class CameraNotes:
    """Watches the poses of a run and says what is new; the same thing is said once."""

    def __init__(self) -> None:
        self._kind: CameraKind | None = None
        self._warning = ""
        self._notes: list[str] = []
        self._left_out = 0

    def follow(self, step: Step) -> CameraNote | None:
        """What is new with this frame, if anything."""
        pose, note = step.camera, None
        about, _, _ = pose.warning.rpartition(" by ")  # the amount is measured again and again
        if (about or pose.warning) != self._warning:
            self._warning = about or pose.warning
            text = pose.warning or f"camera back in its place at frame {step.frame.index}"
            note = CameraNote(text, bool(pose.warning))
        elif pose.kind is not None and pose.kind is not self._kind:
            self._kind = pose.kind
            verb = "stands" if pose.kind is CameraKind.FIXED else "moves"
            note = CameraNote(f"{verb} from frame {step.frame.index}", False)
        if note is not None:
            self._keep(note.text)
        elif pose.warning and self._notes:
            self._notes[-1] = pose.warning
        return note

    def all(self) -> tuple[str, ...]:
        """What was said so far; of very much, the first."""
        more = (f"and {self._left_out} changes more",) if self._left_out else ()
        return (*self._notes, *more)

    def _keep(self, text: str) -> None:
        if len(self._notes) < _MOST_KEPT:
            self._notes.append(text)
        else:
            self._left_out += 1
