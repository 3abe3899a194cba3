"""Sources of frames: `open_source` opens any of them.

Importing this package imports neither PyAV nor OpenCV; opening a source does.
"""

from __future__ import annotations

import glob
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from streamtrack.errors import SourceError
from streamtrack.sources.addresses import NETWORK_SCHEMES, STDIN, AddressKind, kind_of, redacted

if TYPE_CHECKING:
    from streamtrack.settings import LiveSettings
    from streamtrack.sources.base import FrameSource

__all__ = ["FrameSource", "open_source"]


def __getattr__(name: str) -> Any:
    # Late, as the reader of network streams imports this package and needs no NumPy.
    if name != "FrameSource":
        raise AttributeError(f"module 'streamtrack.sources' has no attribute '{name}'")
    from streamtrack.sources.base import FrameSource

    return FrameSource


def open_source(
    uri: str | Path | Sequence[str | Path],
    *,
    with_packets: bool = False,
    live: LiveSettings | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> FrameSource:
    """Open a file, pictures (folder, glob, list), a camera, a stream, or ``synthetic://``.

    Cameras (``/dev/video0``, ``/dev/v4l/by-id/...``, ``v4l2://``), network addresses and ``-``
    (standard input) give a `LiveSource`, opened by ``live``; ``should_stop`` ends its waiting.
    ``with_packets`` asks videos and streams for their encoded packets; other sources have none.
    Raises SourceError or UsageError with a line that says what to do and holds no credentials.
    """
    if not isinstance(uri, str | Path):
        return _images(uri)
    # A Path has lost the second slash of "://" and can only be a file, or a device.
    kind = kind_of(str(uri))
    if kind is AddressKind.SYNTHETIC:
        from streamtrack.sources.synthetic import SyntheticSource

        return SyntheticSource(str(uri))
    if kind is AddressKind.CAMERA:
        return _camera(str(uri), live, should_stop)
    if kind in (AddressKind.NETWORK, AddressKind.STDIN):
        return _stream(str(uri), with_packets, live, should_stop)
    if kind is AddressKind.UNKNOWN:
        raise _unknown_scheme(str(uri))
    path = Path(uri).expanduser()
    if path.is_dir() or (glob.has_magic(str(uri)) and not path.exists()):
        return _images(path)
    return _open_file(path, with_packets)


def _camera(
    uri: str, live: LiveSettings | None, should_stop: Callable[[], bool] | None
) -> FrameSource:
    from streamtrack.sources.live import LiveSource
    from streamtrack.sources.v4l2.camera import V4L2Capture

    return LiveSource(lambda _: V4L2Capture(uri), live, name=uri, should_stop=should_stop)


def _stream(
    uri: str,
    with_packets: bool,
    live: LiveSettings | None,
    should_stop: Callable[[], bool] | None,
) -> FrameSource:
    from streamtrack.settings import LiveSettings
    from streamtrack.sources.live import LiveSource
    from streamtrack.sources.network.stream import NetworkCapture

    settings = live or LiveSettings()
    name = redacted(uri)
    if uri == STDIN:
        name = "standard input"
        settings = settings.model_copy(update={"retries": 0})  # It cannot be opened again.

    def opener(is_stopping: Callable[[], bool]) -> NetworkCapture:
        return NetworkCapture(uri, settings, with_packets=with_packets, should_stop=is_stopping)

    return LiveSource(opener, settings, name=name, should_stop=should_stop)


def _unknown_scheme(uri: str) -> SourceError:
    scheme = uri.partition("://")[0]
    known = ", ".join(f"{name}://" for name in ("synthetic", "v4l2", *NETWORK_SCHEMES))
    return SourceError(f"unknown kind of source {scheme}://: known are {known}, files and folders")


def _open_file(path: Path, with_packets: bool) -> FrameSource:
    from streamtrack.sources.images import is_picture_name

    if is_picture_name(path):
        return _images(path)
    from streamtrack.sources.video import VideoSource

    return VideoSource(path, with_packets=with_packets)


def _images(source: Path | Sequence[str | Path]) -> FrameSource:
    from streamtrack.sources.images import ImageSource

    return ImageSource(source)
