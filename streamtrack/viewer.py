"""Opening a recording in the Rerun viewer: its own window, or a page in the browser."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import time
import webbrowser
from pathlib import Path
from urllib.parse import quote

from streamtrack.errors import SourceError

_LOOPBACK = "127.0.0.1"  # the viewer itself would listen on every interface
_MAGIC = (b"RRF2", b"RRF3", b"RRIO")
_START_TIMEOUT_S = 20.0


def viewer_executable() -> Path:
    """The viewer of the rerun-sdk wheel, not the wrapper script, which would outlive a kill.

    Raises SourceError if the wheel has none.
    """
    spec = importlib.util.find_spec("rerun_cli")
    for folder in (spec.submodule_search_locations or []) if spec else []:
        for name in ("rerun", "rerun.exe"):
            if (path := Path(folder) / name).is_file():
                return path
    raise SourceError("the Rerun viewer is not installed: reinstall rerun-sdk for this platform")


def check_recording(path: Path) -> None:
    """Raise SourceError unless ``path`` is a Rerun recording."""
    try:
        with path.open("rb") as file:
            magic = file.read(4)
    except OSError as error:
        raise SourceError(f"recording {path}: {error.strerror or error}") from None
    if magic not in _MAGIC:
        raise SourceError(f"recording {path} is not a Rerun recording (.rrd)")


def view(path: Path, web: bool = False, port: int | None = None) -> int:
    """Show a recording until the viewer is closed, or Ctrl-C; the viewer's exit code.

    Only this machine can connect. With ``web`` a page is served on ``port`` and opened in the
    browser. Raises SourceError if there is no such recording, no viewer or no screen for it.
    """
    check_recording(path)
    viewer = viewer_executable()
    if not web and _has_no_screen():
        raise SourceError("no screen to open the viewer on: use 'streamtrack view --web'")
    page_port, data_port = port or _free_port(), _free_port()
    if web:
        options = ["--serve-web", "--web-viewer-port", str(page_port), "--port", str(data_port)]
    else:
        options = ["--port", str(port) if port else "auto"]
    command = [str(viewer), str(path), "--bind", _LOOPBACK, *options]
    with subprocess.Popen(command) as process:
        try:
            if web and _answers(page_port, process):
                _open_page(page_port, data_port)
            return process.wait()
        except KeyboardInterrupt:
            return 0
        finally:
            process.terminate()


def page_url(page_port: int, data_port: int) -> str:
    """Address of the served viewer, told where its data is."""
    data = quote(f"rerun+http://{_LOOPBACK}:{data_port}/proxy", safe="")
    return f"http://{_LOOPBACK}:{page_port}/?url={data}&hide_welcome_screen=1"


def _open_page(page_port: int, data_port: int) -> None:
    url = page_url(page_port, data_port)
    sys.stdout.write(f"{url}\nCtrl-C ends it\n")
    sys.stdout.flush()
    webbrowser.open(url)


def _has_no_screen() -> bool:
    return sys.platform == "linux" and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((_LOOPBACK, 0))
        port: int = probe.getsockname()[1]
        return port


def _answers(port: int, process: subprocess.Popen[bytes]) -> bool:
    """True once the server listens, False if it ended or took too long."""
    deadline = time.monotonic() + _START_TIMEOUT_S
    while process.poll() is None and time.monotonic() < deadline:
        try:
            socket.create_connection((_LOOPBACK, port), timeout=1.0).close()
        except OSError:
            time.sleep(0.1)
        else:
            return True
    return False
