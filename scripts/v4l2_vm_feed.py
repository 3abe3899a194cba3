"""Feeds numbered pictures into a v4l2loopback device, until it is killed.

usage: v4l2_vm_feed.py DEVICE FOURCC WIDTHxHEIGHT DAMAGED_EVERY      0: none is damaged
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from v4l2_emulator import DEFAULT_FRAMES, default_picture, encode_number, encoded

from streamtrack.sources.v4l2 import api

BUF_TYPE_OUTPUT = 2
COLORSPACE_SRGB = 8
FEED_RATE_HZ = 15


def feed(path: str, fourcc: str, size: str, damaged_every: int) -> None:
    width, height = map(int, size.split("x"))
    frames = []
    for number in range(DEFAULT_FRAMES):
        marked = encode_number(default_picture(width, height, number), number)
        data = encoded(marked, fourcc)
        if damaged_every and number % damaged_every == damaged_every - 1:
            data = data[: len(data) // 2] + data[len(data) // 2 + 2000 :]
        frames.append(data)
    fd = os.open(path, os.O_RDWR)
    wanted = api.Format(type=BUF_TYPE_OUTPUT)
    pix = wanted.fmt.pix
    pix.width, pix.height, pix.pixelformat = width, height, api.code_of(fourcc)
    pix.field, pix.sizeimage = api.FIELD_NONE, width * height * 2
    pix.bytesperline = 2 * width if fourcc == "YUYV" else 0
    pix.colorspace = COLORSPACE_SRGB
    api.ioctl(fd, api.S_FMT, wanted)
    os.write(fd, frames[0])
    print("ready", flush=True)
    due_s = time.monotonic()
    for number in range(1, 100_000):
        due_s += 1 / FEED_RATE_HZ
        time.sleep(max(0, due_s - time.monotonic()))
        os.write(fd, frames[number % DEFAULT_FRAMES])


if __name__ == "__main__":
    feed(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]))
