"""A picture of a recording as the Rerun viewer shows it, without a screen.

    python scripts/rrd_screenshot.py FILE.rrd OUT.png [--frame N] [--web]

Without --web the native viewer draws, by software if there is no GPU; it shows AV1 and JPEG, and
H.264, H.265, VP8 and VP9 only with an ffmpeg executable on PATH. With --web headless Chromium
draws, which shows all but H.265; it opens at the start of the recording and plays, so --frame
cannot be had there.
"""

from __future__ import annotations

import argparse
import base64
import ctypes.util
import json
import os
import shlex
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from rerun.experimental import ViewerClient

from streamtrack.errors import SourceError
from streamtrack.viewer import check_recording, page_url, viewer_executable

NATIVE_PACKAGES = "mesa-vulkan-drivers libvulkan1 libgl1-mesa-dri libegl1 libgl1 libxkbcommon0"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER_FLAGS = (
    "--headless=new",
    "--remote-debugging-pipe",
    "--no-sandbox",
    "--hide-scrollbars",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
SIZE_WH = (1920, 1080)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--frame", type=int, help="frame to show (native viewer only)")
    parser.add_argument("--web", action="store_true", help="draw with headless Chromium")
    parser.add_argument("--wait", type=float, default=60.0, help="seconds for the page to draw")
    options = parser.parse_args()
    try:
        check_recording(options.recording)
        if options.web:
            shoot_web(options.recording, options.picture, options.wait)
        else:
            shoot_native(options.recording, options.picture, options.frame)
    except (SourceError, RuntimeError, OSError, ConnectionError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def shoot_native(recording: Path, picture: Path, frame: int | None) -> None:
    """Write what the native viewer draws; the first shots are taken before all is decoded."""
    if ctypes.util.find_library("vulkan") is None:
        raise SourceError(f"no Vulkan library: apt-get install {NATIVE_PACKAGES}")
    viewer = ViewerClient.spawn(
        headless=True,
        port=free_port(),
        memory_limit="2GB",
        hide_welcome_screen=True,
        executable_path=str(viewer_executable()),
    )
    try:
        viewer.open(str(recording.resolve()))
        time.sleep(2.0)
        if frame is not None:
            viewer.set_time("frame", sequence=frame, play_state="paused")
        for _ in range(4):
            picture.write_bytes(viewer.take_screenshot())
            time.sleep(1.0)
    finally:
        viewer.quit()


def shoot_web(recording: Path, picture: Path, wait_s: float) -> None:
    """Write what Chromium has drawn ``wait_s`` seconds after it was sent to the page."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        raise SourceError("no Chromium: apt-get install chromium")
    with served(recording) as url, tempfile.TemporaryDirectory() as profile:
        command = [browser, *BROWSER_FLAGS, f"--user-data-dir={profile}", "about:blank"]
        with Browser(command) as page:
            page.call("Page.navigate", url=f"{url}&renderer=webgl")
            time.sleep(wait_s)
            shot = page.call("Page.captureScreenshot", format="png")
        picture.write_bytes(base64.b64decode(shot["data"]))


class Browser:
    """The first page of a Chromium that is spoken to over a pair of pipes."""

    def __init__(self, command: list[str]) -> None:
        commands_out, self._commands = os.pipe()
        self._replies, replies_in = os.pipe()
        joined = f"exec {shlex.join(command)} 3<&{commands_out} 4>&{replies_in}"
        self._process = subprocess.Popen(
            ["bash", "-c", joined],
            pass_fds=(commands_out, replies_in),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(commands_out)
        os.close(replies_in)
        self._number = 0
        self._received = b""
        self._session: str | None = None

    def __enter__(self) -> Self:
        pages: list[Any] = []
        while not pages:
            targets = self.call("Target.getTargets")["targetInfos"]
            pages = [target for target in targets if target["type"] == "page"]
        target = pages[0]["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        width, height = SIZE_WH
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait()
        os.close(self._commands)
        os.close(self._replies)

    def call(self, method: str, **params: object) -> dict[str, Any]:
        """One command of the DevTools protocol, and its answer."""
        self._number += 1
        message: dict[str, object] = {"id": self._number, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while True:
            reply = self._reply()
            if reply.get("id") == self._number:
                if "error" in reply:
                    raise RuntimeError(f"{method}: {reply['error']['message']}")
                result: dict[str, Any] = reply["result"]
                return result

    def _reply(self) -> dict[str, Any]:
        while b"\0" not in self._received:
            data = os.read(self._replies, 1 << 20)
            if not data:
                raise RuntimeError("Chromium ended early")
            self._received += data
        reply, _, self._received = self._received.partition(b"\0")
        parsed: dict[str, Any] = json.loads(reply)
        return parsed


@contextmanager
def served(recording: Path) -> Iterator[str]:
    """The web viewer with the recording, on loopback."""
    page_port, data_port = free_port(), free_port()
    command = [str(viewer_executable()), str(recording), "--serve-web", "--bind", "127.0.0.1"]
    ports = ["--port", str(data_port), "--web-viewer-port", str(page_port)]
    with subprocess.Popen(
        [*command, *ports], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as server:
        try:
            time.sleep(3.0)
            yield page_url(page_port, data_port)
        finally:
            server.terminate()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


if __name__ == "__main__":
    sys.exit(main())
