"""Tests of addresses: their kinds, and that no secret is ever shown."""

from __future__ import annotations

import pytest

from streamtrack.errors import SourceError, UsageError
from streamtrack.sources import open_source
from streamtrack.sources.addresses import (
    AddressKind,
    Redactor,
    check_network_address,
    is_live,
    kind_of,
    path_of,
    redacted,
)
from streamtrack.types import SourceInfo


@pytest.mark.parametrize(
    ("address", "path"),
    [
        ("file:///tmp/a%20b%23.mp4", "/tmp/a b#.mp4"),
        ("FILE://localhost/tmp/a.mp4", "/tmp/a.mp4"),
        ("file://elsewhere/a.mp4", "file://elsewhere/a.mp4"),
        ("a%20b.mp4", "a%20b.mp4"),
        ("rtsp://host/x", "rtsp://host/x"),
    ],
)
def test_a_file_address_of_this_machine_is_its_path(address: str, path: str) -> None:
    assert path_of(address) == path


@pytest.mark.parametrize(
    ("address", "kind", "live"),
    [
        ("-", AddressKind.STDIN, True),
        ("/dev/video0", AddressKind.CAMERA, True),
        ("/dev/v4l/by-id/usb-cam-index0", AddressKind.CAMERA, True),
        ("V4L2:///dev/video1?fps=30", AddressKind.CAMERA, True),
        ("RTSP://host/x", AddressKind.NETWORK, True),
        ("https://host/x.m3u8", AddressKind.NETWORK, True),
        ("udp://@:1234", AddressKind.NETWORK, True),
        ("synthetic://board", AddressKind.SYNTHETIC, False),
        ("video.mp4", AddressKind.PATH, False),
        ("./-", AddressKind.PATH, False),
        ("folder/rtsp:/x", AddressKind.PATH, False),
        ("/dev/videos/a.mp4", AddressKind.PATH, False),
        ("ftp://host/x", AddressKind.UNKNOWN, False),
    ],
)
def test_an_address_tells_its_kind(address: str, kind: AddressKind, live: bool) -> None:
    assert (kind_of(address), is_live(address)) == (kind, live)


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("rtsp://host/x", "rtsp://host/x"),
        ("rtsp://me:geheim@host:554/x?a=1", "rtsp://host:554/x?a=1"),
        ("rtsp://me@host/x", "rtsp://host/x"),
        # Characters that should have been written as %XX end the host for a strict parser.
        ("rtsp://me:ge@heim@host/x", "rtsp://host/x"),
        ("rtsp://me:ge/heim@host/x", "rtsp://host/x"),
        ("rtsp://me:ge?heim#@host/x", "rtsp://host/x"),
        ("rtsp://me:ge:heim@[::1]:554/x", "rtsp://[::1]:554/x"),
        ("http://host/v.cgi?user=me&pwd=geheim&fps=5", "http://host/v.cgi?user=***&pwd=***&fps=5"),
        ("http://host/v?Token=geheim", "http://host/v?Token=***"),
        ("rtsp://host/user=me_password=geheim_channel=1_stream=0", "rtsp://host/user=***"),
        ("http://host/v?monkey=1", "http://host/v?monkey=1"),
        ("srt://host:1?passphrase=geheim", "srt://host:1?passphrase=***"),
        ("/dev/video0", "/dev/video0"),
        ("-", "-"),
    ],
)
def test_an_address_is_shown_without_its_secrets(address: str, shown: str) -> None:
    assert redacted(address) == shown
    assert "geheim" not in shown
    assert redacted(shown) == shown
    assert "geheim" not in SourceInfo(shown, (1, 1), None, None).name


@pytest.mark.parametrize(
    "text",
    [
        "rtsp://me:ge%40heim@host/x: Connection refused",
        "method DESCRIBE failed for rtsp://me:ge%40heim@host:554/x",
        "user me with password ge@heim was refused",
        "Authorization: ge%40heim",
        "opening https://other:ge%40heim@mirror/y instead",
        "redirected to http://host/v?password=ge@heim&x=1",
    ],
)
def test_a_redactor_finds_the_secrets_in_any_text(text: str) -> None:
    clean = Redactor("rtsp://me:ge%40heim@host/x")(text)
    assert "heim" not in clean
    assert clean != text


def test_a_redactor_leaves_other_text_alone() -> None:
    text = "Connection refused: check the address of host (port 554)"
    assert Redactor("rtsp://ab:x@host:554/y")(text) == text


@pytest.mark.parametrize(
    "address",
    [
        "rtsp://host/x",
        "rtsp://me:p@host:554",
        "http://[::1]:8080/x",
        "udp://@:1234",
        "udp://239.0.0.1:1234?reuse=1",
        "tcp://host:99",
        "https://me:p%2Fq@host",
    ],
)
def test_an_address_that_can_be_right_passes(address: str) -> None:
    check_network_address(address)


@pytest.mark.parametrize(
    ("address", "match"),
    [
        ("rtsp://me:geheim/1@host/x", "no valid port"),
        ("rtsp://host:99999/x", "no valid port"),
        ("rtsp://host:0/x", "no valid port"),
        ("http://me:geheim@/x", "no host"),
        ("rtsp:///x", "no host"),
        ("tcp://host", "needs a port"),
        ("udp://@", "needs a port"),
        ("http://me:geheim@ho st/x", "no spaces"),
    ],
)
def test_an_address_that_cannot_be_right_is_refused(address: str, match: str) -> None:
    with pytest.raises(UsageError, match=match) as refused:
        open_source(address)
    assert "geheim" not in str(refused.value)


def test_an_unknown_scheme_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(SourceError, match=r"ftp://: known are synthetic://, v4l2://, rtsp://"):
        open_source("ftp://me:geheim@host/x")
