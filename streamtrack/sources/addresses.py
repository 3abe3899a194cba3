"""Addresses of live sources: what kind they are, and how they are shown without their secrets.

Standard library only, as the command line asks for the kind of a source before it opens anything.
"""

from __future__ import annotations

import re
from enum import StrEnum
from urllib.parse import unquote

from streamtrack.errors import UsageError

STDIN = "-"
NETWORK_SCHEMES = ("rtsp", "rtsps", "http", "https", "udp", "tcp", "srt", "rtmp", "rtmps")
_SECRET_KEYS = (
    "password|passwd|passphrase|pass|pwd|psw|pw|user|username|usr|login|account|"
    "token|access_token|auth|authorization|apikey|api_key|key|secret|sig|signature|session|sid"
)
# "user=admin" and "pwd=x" in a query; some cameras have them in the path, joined by "_" or "&".
_SECRET_PAIR = re.compile(rf"(?i)(^|[?&;/_]|\b)({_SECRET_KEYS})=([^&;/?#\s]*)")
_USERINFO = re.compile(r"([a-zA-Z][a-zA-Z0-9+.-]*://)[^/\s]*@")
_DEVICE = re.compile(r"/dev/(video\d|v4l/)")
_HOST = re.compile(r"\[[0-9A-Fa-f:.%]+\]|[^:\[\]]*")
_MIN_SECRET_LENGTH = 3
"""Shorter secrets are not looked for in free text: it would be torn to shreds."""


class AddressKind(StrEnum):
    """What is behind an address."""

    CAMERA = "camera"
    NETWORK = "network"
    STDIN = "stdin"
    SYNTHETIC = "synthetic"
    PATH = "path"
    UNKNOWN = "unknown"


def kind_of(address: str) -> AddressKind:
    """The kind of an address, by its look alone: nothing is opened.

    A ``PATH`` is a file, folder or glob; ``UNKNOWN`` has a scheme that is not known.
    """
    if address == STDIN:
        return AddressKind.STDIN
    if _DEVICE.match(address):
        return AddressKind.CAMERA
    scheme, separator, _ = address.partition("://")
    if not separator:
        return AddressKind.PATH
    scheme = scheme.lower()
    if scheme == "v4l2":
        return AddressKind.CAMERA
    if scheme == "synthetic":
        return AddressKind.SYNTHETIC
    return AddressKind.NETWORK if scheme in NETWORK_SCHEMES else AddressKind.UNKNOWN


def path_of(address: str) -> str:
    """The path behind a ``file://`` address of this machine (RFC 8089); all else as it is."""
    for start in ("file:///", "file://localhost/"):
        if address.lower().startswith(start):
            return "/" + unquote(address[len(start) :])
    return address


def is_live(address: str) -> bool:
    """True for what is read as a live stream: cameras, network addresses and ``-``."""
    return kind_of(address) in (AddressKind.CAMERA, AddressKind.NETWORK, AddressKind.STDIN)


def redacted(address: str) -> str:
    """The address as it may be shown: without user, password, and values that look like secrets.

    Everything up to the last ``@`` goes, because a password may hold any character. What stands
    in the path or query under a name such as ``password`` or ``token`` becomes ``***``.
    """
    scheme, separator, rest = address.partition("://")
    if not separator:
        return address
    return f"{scheme}://" + _SECRET_PAIR.sub(r"\1\2=***", rest.rpartition("@")[2])


class Redactor:
    """Takes the secrets of one address out of any text, such as FFmpeg's messages."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._shown = redacted(address)
        self._secrets = sorted(secrets_of(address), key=len, reverse=True)

    def __call__(self, text: str) -> str:
        """``text`` without the secrets."""
        text = text.replace(self._address, self._shown)
        text = _USERINFO.sub(r"\1", text)
        for secret in self._secrets:
            text = text.replace(secret, "***")
        return _SECRET_PAIR.sub(r"\1\2=***", text)


def secrets_of(address: str) -> set[str]:
    """Passwords, and users that come with one, as written and as meant."""
    _, _, rest = address.partition("://")
    userinfo, separator, plain = rest.rpartition("@")
    user, _, password = userinfo.partition(":")
    found = {userinfo, user, password} if separator else set()
    found |= {match.group(3) for match in _SECRET_PAIR.finditer(plain)}
    found |= {unquote(secret) for secret in found}
    return {secret for secret in found if len(secret) >= _MIN_SECRET_LENGTH}


def check_network_address(address: str) -> None:
    """Raise UsageError, which shows no secret, for an address that cannot be right."""
    scheme, _, rest = address.partition("://")
    scheme = scheme.lower()
    # As FFmpeg divides it: the host follows the last "@" before the first "/", "?" or "#".
    authority = re.split(r"[/?#]", rest, maxsplit=1)[0].rpartition("@")[2]
    if re.search(r"\s", address):
        raise UsageError(f"{redacted(address)}: an address holds no spaces: write %20")
    match = _HOST.match(authority)
    host = match.group() if match else ""
    after = authority[len(host) :]
    port = after[1:]
    if after and not (after[0] == ":" and port.isascii() and port.isdigit() and _is_port(port)):
        # What stands there may be a part of the password, so it is not shown.
        raise UsageError(
            f"the {scheme}:// address has no valid port: write {_pattern(scheme)}, and special "
            "characters of a password as %XX (/ %2F, ? %3F, # %23, @ %40, : %3A)"
        )
    if not host and scheme not in ("udp", "srt"):
        raise UsageError(f"the {scheme}:// address has no host: write {_pattern(scheme)}")
    if not port and scheme in ("udp", "tcp", "srt"):
        raise UsageError(f"the {scheme}:// address needs a port: write {_pattern(scheme)}")


def _is_port(text: str) -> bool:
    return len(text) <= 5 and 0 < int(text) < 65536


def _pattern(scheme: str) -> str:
    patterns = {
        "udp": "udp://@:PORT to listen, or udp://@GROUP:PORT",
        "tcp": "tcp://HOST:PORT",
        "srt": "srt://HOST:PORT",
    }
    return patterns.get(scheme, f"{scheme}://USER:PASSWORD@HOST:PORT/PATH")
