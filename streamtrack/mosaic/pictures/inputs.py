"""What is on the command line: pictures, folders and globs, or a stream."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path

from streamtrack.errors import SourceError
from streamtrack.sources.images import find_pictures, is_picture_name


def is_stream(uri: str) -> bool:
    """True for videos, cameras, network and synthetic streams; a folder or glob is a set."""
    if "://" in uri or uri == "-" or uri.startswith("/dev/video"):
        return True
    path = Path(uri).expanduser()
    if path.is_dir() or (glob.has_magic(uri) and not path.exists()):
        return False
    return path.is_file() and not is_picture_name(path)


def picture_paths(inputs: Sequence[str]) -> list[Path]:
    """All pictures of files, folders and globs, each input's in natural order.

    Raises SourceError if one of them does not exist or holds no pictures.
    """
    paths: list[Path] = []
    for given in inputs:
        if is_stream(given):
            raise SourceError(
                f"{given} is no picture: a mosaic is made of pictures, or of one video alone"
            )
        paths += find_pictures(Path(given).expanduser())
    return paths
