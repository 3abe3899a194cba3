"""Sources of frames: `open_source` opens any of them.

Importing this package imports neither PyAV nor OpenCV; opening a source does.
"""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path

from streamtrack.errors import SourceError
from streamtrack.sources.base import FrameSource

__all__ = ["FrameSource", "open_source"]

_LIVE_SCHEMES = ("v4l2", "rtsp", "http", "https", "udp")
_KNOWN_SCHEMES = ("synthetic", *_LIVE_SCHEMES)


def open_source(
    uri: str | Path | Sequence[str | Path], *, with_packets: bool = False
) -> FrameSource:
    """Open a video file, a folder, glob or list of pictures, or a ``synthetic://`` scene.

    ``with_packets`` asks video files for their encoded packets (see `VideoSource`); other sources
    have none. Raises SourceError with a line that says what to do.
    """
    if not isinstance(uri, str | Path):
        return _images(uri)
    text = str(uri)
    scheme, separator, _ = text.partition("://")
    # A Path has lost the second slash of "://" and can only be a file.
    if separator and isinstance(uri, str):
        return _open_scheme(scheme.lower(), text)
    if text == "-" or text.startswith("/dev/video"):
        raise _live_error(text)
    path = Path(text).expanduser()
    if path.is_dir() or (glob.has_magic(text) and not path.exists()):
        return _images(path)
    return _open_file(path, with_packets)


def _open_scheme(scheme: str, uri: str) -> FrameSource:
    if scheme == "synthetic":
        from streamtrack.sources.synthetic import SyntheticSource

        return SyntheticSource(uri)
    if scheme in _LIVE_SCHEMES:
        raise _live_error(uri)
    known = ", ".join(f"{name}://" for name in _KNOWN_SCHEMES)
    raise SourceError(f"unknown kind of source {scheme}://: known are {known}, files and folders")


def _live_error(uri: str) -> SourceError:
    # The address may hold a password; it is not repeated in full.
    scheme, separator, rest = uri.partition("://")
    shown = f"{scheme}://{rest.rpartition('@')[2]}" if separator else uri
    return SourceError(
        f"{shown}: live sources are not supported by this version yet: record to a file first"
    )


def _open_file(path: Path, with_packets: bool) -> FrameSource:
    from streamtrack.sources.images import is_picture_name

    if is_picture_name(path):
        return _images(path)
    from streamtrack.sources.video import VideoSource

    return VideoSource(path, with_packets=with_packets)


def _images(source: Path | Sequence[str | Path]) -> FrameSource:
    from streamtrack.sources.images import ImageSource

    return ImageSource(source)
