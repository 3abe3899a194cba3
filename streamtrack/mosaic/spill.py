"""Room on disk for what does not fit into memory: an unnamed file that no end of a run leaves."""

from __future__ import annotations

import os
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

from streamtrack.errors import OutputError
from streamtrack.outputs import output_error

_UNIT = 16 * 1024


@dataclass(frozen=True, slots=True)
class Slot:
    """A place in a spill file: ``length`` bytes of data in ``capacity`` bytes of room."""

    offset: int
    length: int
    capacity: int


class SpillFile:
    """Blocks of bytes in a temporary file that has no name, so the system always takes it away.

    The file is made at the first block, in ``folder`` or where `tempfile` puts things ($TMPDIR).
    Freed room is used again, the smallest piece that fits first.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = Path(tempfile.gettempdir()) if folder is None else folder
        self._descriptor: int | None = None
        self._size = 0
        self._free: defaultdict[int, list[int]] = defaultdict(list)

    @property
    def size_mb(self) -> float:
        """Length of the file in MB (1e6 bytes)."""
        return self._size / 1e6

    def put(self, data: bytes | memoryview) -> Slot:
        """Store a block. Raises OutputError, and then nothing is stored."""
        slot = self._room_for(len(data))
        try:
            rest, offset = memoryview(data), slot.offset
            while rest:
                written = os.pwrite(self._open(), rest, offset)
                rest, offset = rest[written:], offset + written
        except OSError as error:
            self.free(slot)
            raise self._failure(error) from None
        return slot

    def get(self, slot: Slot) -> bytes:
        """The block of a slot. Raises OutputError if the disk fails."""
        parts, offset, left = [], slot.offset, slot.length
        try:
            while left:
                part = os.pread(self._open(), left, offset)
                if not part:
                    raise OSError("the temporary file is shorter than it was")
                parts.append(part)
                offset, left = offset + len(part), left - len(part)
        except OSError as error:
            raise self._failure(error) from None
        return b"".join(parts)

    def free(self, slot: Slot) -> None:
        """Give a slot's room back."""
        self._free[slot.capacity].append(slot.offset)

    def close(self) -> None:
        """Take the file away; further calls do nothing."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def _room_for(self, length: int) -> Slot:
        needed = -(-length // _UNIT) * _UNIT
        fitting = [c for c, places in self._free.items() if needed <= c <= 2 * needed and places]
        if fitting:
            capacity = min(fitting)
            return Slot(self._free[capacity].pop(), length, capacity)
        slot = Slot(self._size, length, needed)
        self._size += needed
        return slot

    def _open(self) -> int:
        if self._descriptor is None:
            # A duplicate of the descriptor outlives the Python file, and so does the unnamed file.
            with tempfile.TemporaryFile(dir=self._folder) as file:
                self._descriptor = os.dup(file.fileno())
        return self._descriptor

    def _failure(self, error: OSError) -> OutputError:
        cause = output_error(self._folder / "mosaic tiles", error)
        return OutputError(f"{cause} (TMPDIR names the folder)")
