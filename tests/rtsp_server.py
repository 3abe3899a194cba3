"""GStreamer's RTSP server on 127.0.0.1, showing a ball at 320x240, 30 a second.

It needs Debian's Python bindings (scripts/setup-servers), so it runs under the system's Python.
"""

from __future__ import annotations

import shutil
import subprocess

PYTHON = "/usr/bin/python3"
_PROGRAM = """
import sys, gi
gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer
Gst.init(None)
server = GstRtspServer.RTSPServer()
server.set_address("127.0.0.1")
server.set_service(sys.argv[1])
factory = GstRtspServer.RTSPMediaFactory()
factory.set_shared(True)
factory.set_launch(
    "( videotestsrc is-live=true pattern=ball ! video/x-raw,width=320,height=240,framerate=30/1 "
    "! x264enc tune=zerolatency speed-preset=ultrafast key-int-max=30 "
    "! rtph264pay name=pay0 config-interval=0 )"
)
if len(sys.argv) > 2:
    auth = GstRtspServer.RTSPAuth()
    token = GstRtspServer.RTSPToken()
    token.set_string("media.factory.role", "user")
    auth.add_basic(GstRtspServer.RTSPAuth.make_basic(*sys.argv[2:]), token)
    server.set_auth(auth)
    permissions = GstRtspServer.RTSPPermissions()
    permissions.add_permission_for_role("user", "media.factory.access", True)
    permissions.add_permission_for_role("user", "media.factory.construct", True)
    factory.set_permissions(permissions)
server.get_mount_points().add_factory("/cam", factory)
if not server.attach(None):
    sys.exit("port taken")
print(server.get_bound_port(), flush=True)
GLib.MainLoop().run()
"""


def missing() -> str:
    """Why it cannot be started, or empty."""
    probe = (
        "import gi; gi.require_version('Gst', '1.0'); gi.require_version('GstRtspServer', '1.0'); "
        "from gi.repository import Gst, GstRtspServer; Gst.init(None); "
        "assert Gst.ElementFactory.find('x264enc') and Gst.ElementFactory.find('rtph264pay')"
    )
    if not shutil.which(PYTHON):
        return f"no {PYTHON}"
    done = subprocess.run([PYTHON, "-c", probe], capture_output=True, timeout=30)
    return "" if done.returncode == 0 else "scripts/setup-servers was not run"


def start(port: int = 0, *credentials: str) -> tuple[subprocess.Popen[str], int]:
    """The process and its port, a free one for 0; credentials are a user and a password."""
    server = subprocess.Popen(
        [PYTHON, "-c", _PROGRAM, str(port), *credentials],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert server.stdout is not None
    return server, int(server.stdout.readline())


def stop(server: subprocess.Popen[str]) -> None:
    server.kill()
    server.wait()
    if server.stdout is not None:
        server.stdout.close()
