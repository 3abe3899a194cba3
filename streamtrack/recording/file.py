"""The .rrd files behind one recording stream, one after the other, and the disk they are on."""

from __future__ import annotations

import datetime
import os
import time
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings

from streamtrack.errors import OutputError
from streamtrack.recording.entities import APPLICATION_ID
from streamtrack.recording.series import Hold

_FLUSH_EVERY_S = 0.2
_FLUSH_BYTES = 1 << 24
"""More than 0.2 s of any entity. Where one is handed over for its size, Rerun 0.41 leaves out the
next turn of all the others: beside large pictures small values would wait until the end."""
_RESERVE_BYTES = 1 << 21
"""Space kept on the disk so that a recording can still be ended properly."""
_RESERVE_PICTURES = 8
_GROWTH_CHECK_S = 5.0
_FLUSH_TIMEOUT_S = 30.0


def new_stream(recording_id: str | None = None) -> rr.RecordingStream:
    """A stream that hands over what was logged at most 0.2 s ago."""
    batching = rr.ChunkBatcherConfig.DEFAULT()
    batching.flush_tick = datetime.timedelta(seconds=_FLUSH_EVERY_S)
    batching.flush_num_bytes = _FLUSH_BYTES
    return rr.RecordingStream(APPLICATION_ID, recording_id=recording_id, batcher_config=batching)


class Layout:
    """The layout to view a recording in, for any number of files.

    Each use of ``RecordingStream.save(default_blueprint=...)`` would leave two threads and their
    buffers behind (Rerun 0.41); here one stream serves all files.
    """

    def __init__(self, blueprint: rrb.Blueprint) -> None:
        self._blueprint = blueprint
        native = rerun_bindings.new_blueprint(
            application_id=APPLICATION_ID,
            make_default=False,
            make_thread_default=False,
            default_enabled=True,
        )
        self._stream = rr.RecordingStream._from_native(native)

    def messages(self) -> rerun_bindings.PyMemorySinkStorage:
        """The layout once more, to be used up."""
        storage = rerun_bindings.memory_recording(recording=self._stream.to_native())
        assert storage is not None
        self._stream.set_time("blueprint", sequence=0)
        self._blueprint._log_to_stream(self._stream)
        return storage


class RecordingFiles:
    """Opens and closes files for a stream; one is open at a time, and held against others."""

    def __init__(self, stream: rr.RecordingStream, blueprint: rrb.Blueprint) -> None:
        self._stream = stream
        self._layout = Layout(blueprint)
        self._path = Path()
        self._hold: Hold | None = None
        self._growth = (0.0, 0)

    def open(self, path: Path) -> None:
        """Close the file before, and send what is logged from now on to ``path``, emptied.

        Raises OutputError, also if another process is writing there.
        """
        check_writable(path)
        hold = Hold(path)
        try:
            rerun_bindings.save(
                path=str(path),
                default_blueprint=self._layout.messages(),
                recording=self._stream.to_native(),
            )
        except (OSError, RuntimeError) as error:
            hold.release()
            raise OutputError(f"recording {path} cannot be written: {error}") from None
        self._release()
        self._hold = hold
        self._path = path
        self._growth = (time.monotonic(), 0)

    def size_bytes(self) -> int:
        """What has arrived on the disk of the open file; the last moment is still on its way."""
        try:
            return self._path.stat().st_size
        except OSError:
            return 0

    def trouble(self, picture_bytes: int) -> str | None:
        """Why recording has to end, before Rerun gives up by itself in the middle of a message."""
        try:
            if free_bytes(self._path.parent) < reserve_bytes(picture_bytes):
                return "the disk is full"
            since, size = self._growth
            now = time.monotonic()
            if now - since > _GROWTH_CHECK_S:
                self._growth = (now, self._path.stat().st_size)
                if self._growth[1] == size:
                    self._stream.flush(timeout_sec=1.0)
        except OSError as error:
            return str(error.strerror or error)
        except (RuntimeError, ValueError) as error:
            return f"the file cannot be written any more ({error})"
        return None

    def close(self) -> bool:
        """End the open file; False if its end could not be written."""
        is_whole = True
        try:
            self._stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except (RuntimeError, ValueError):
            is_whole = False
        self._stream.disconnect()
        self._release()
        return is_whole

    def _release(self) -> None:
        if self._hold is not None:
            self._hold.release()
            self._hold = None


def free_bytes(folder: Path) -> int:
    """Space that an ordinary user has on the disk of ``folder``. Raises OSError."""
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize


def reserve_bytes(picture_bytes: int) -> int:
    return _RESERVE_BYTES + _RESERVE_PICTURES * picture_bytes


def check_writable(path: Path) -> None:
    """Make the folder and the file. Raises OutputError if that fails."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab"):
            pass
    except OSError as error:
        raise OutputError(f"recording {path}: {error.strerror or error}") from None
