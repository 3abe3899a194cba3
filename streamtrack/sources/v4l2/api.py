"""The part of the kernel's Video4Linux2 interface that capturing needs, by ctypes.

Names, layouts and numbers are those of ``linux/videodev2.h``; structures have the size that the
running machine gives them (32 and 64 bit), and the request numbers follow from it.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
from ctypes import c_char, c_int32, c_long, c_uint8, c_uint32, c_ulong, c_void_p

CAP_VIDEO_CAPTURE = 0x1
CAP_VIDEO_OUTPUT = 0x2
CAP_VIDEO_CAPTURE_MPLANE = 0x1000
CAP_VIDEO_OUTPUT_MPLANE = 0x2000
CAP_VIDEO_M2M_MPLANE = 0x4000
CAP_VIDEO_M2M = 0x8000
CAP_META_CAPTURE = 0x0080_0000
CAP_STREAMING = 0x0400_0000
CAP_META_OUTPUT = 0x0800_0000
CAP_DEVICE_CAPS = 0x8000_0000
CAP_TIMEPERFRAME = 0x1000

BUF_TYPE_CAPTURE = 1
BUF_TYPE_CAPTURE_MPLANE = 9
MEMORY_MMAP = 1
MAX_PLANES = 8
FIELD_NONE = 1
INTERLACED_FIELDS = (2, 3, 7)
"""Top, bottom, alternate: one picture holds every other line only."""
BUF_FLAG_ERROR = 0x40
BUF_FLAG_CLOCK_MASK = 0xE000
BUF_FLAG_CLOCK_MONOTONIC = 0x2000
QUANTIZATION_FULL_RANGE = 1
COLORSPACE_JPEG = 7
SIZE_DISCRETE = 1

CTRL_INTEGER = 1
CTRL_BOOLEAN = 2
CTRL_MENU = 3
CTRL_INTEGER_MENU = 9
CTRL_FLAG_DISABLED = 0x1
CTRL_FLAG_READ_ONLY = 0x4
CTRL_FLAG_INACTIVE = 0x10
CTRL_FLAG_NEXT = 0x8000_0000


class Capability(ctypes.Structure):
    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FormatDescription(ctypes.Structure):
    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FrameSizeEnum(ctypes.Structure):
    """``values``: width, height if discrete, else least, largest and step of each."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("values", c_uint32 * 6),
        ("reserved", c_uint32 * 2),
    )


class FrameIntervalEnum(ctypes.Structure):
    """``values``: numerator, denominator; of the least, the largest and the step if a range."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("type", c_uint32),
        ("values", c_uint32 * 6),
        ("reserved", c_uint32 * 2),
    )


class PixFormat(ctypes.Structure):
    _fields_ = tuple(
        (name, c_uint32)
        for name in (
            *("width", "height", "pixelformat", "field", "bytesperline", "sizeimage"),
            *("colorspace", "priv", "flags", "ycbcr_enc", "quantization", "xfer_func"),
        )
    )


class PlanePixFormat(ctypes.Structure):
    _fields_ = (
        ("sizeimage", c_uint32),
        ("bytesperline", c_uint32),
        ("reserved", c_uint8 * 12),
    )


class PixFormatMplane(ctypes.Structure):
    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("colorspace", c_uint32),
        ("plane_fmt", PlanePixFormat * MAX_PLANES),
        ("num_planes", c_uint8),
        ("flags", c_uint8),
        ("ycbcr_enc", c_uint8),
        ("quantization", c_uint8),
        ("xfer_func", c_uint8),
        ("reserved", c_uint8 * 7),
    )


class _FormatUnion(ctypes.Union):
    _fields_ = (
        ("pix", PixFormat),
        ("pix_mp", PixFormatMplane),
        ("raw", c_uint8 * 200),
        ("align", c_void_p),  # other members hold pointers
    )


class Format(ctypes.Structure):
    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class CaptureParm(ctypes.Structure):
    _fields_ = (
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("numerator", c_uint32),
        ("denominator", c_uint32),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint32 * 4),
    )


class _ParmUnion(ctypes.Union):
    _fields_ = (("capture", CaptureParm), ("raw", c_uint8 * 200))


class StreamParm(ctypes.Structure):
    _fields_ = (("type", c_uint32), ("parm", _ParmUnion))


class RequestBuffers(ctypes.Structure):
    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint32),
    )


class _PlaneUnion(ctypes.Union):
    _fields_ = (("mem_offset", c_uint32), ("userptr", c_ulong))


class Plane(ctypes.Structure):
    _fields_ = (
        ("bytesused", c_uint32),
        ("length", c_uint32),
        ("m", _PlaneUnion),
        ("data_offset", c_uint32),
        ("reserved", c_uint32 * 11),
    )


Planes = Plane * MAX_PLANES


class _Timeval(ctypes.Structure):
    _fields_ = (("tv_sec", c_long), ("tv_usec", c_long))


class _BufferUnion(ctypes.Union):
    _fields_ = (("offset", c_uint32), ("userptr", c_ulong), ("planes", ctypes.POINTER(Plane)))


class Buffer(ctypes.Structure):
    """``length`` is the count of planes if there are ``planes``, else the size in bytes."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("timestamp", _Timeval),
        ("timecode", c_uint32 * 4),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _BufferUnion),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class QueryControl(ctypes.Structure):
    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int32),
        ("maximum", c_int32),
        ("step", c_int32),
        ("default_value", c_int32),
        ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    )


class QueryMenu(ctypes.Structure):
    """``name`` holds an int64 for menus of integers."""

    _fields_ = (
        ("id", c_uint32),
        ("index", c_uint32),
        ("name", c_uint8 * 32),
        ("reserved", c_uint32),
    )


class Control(ctypes.Structure):
    _fields_ = (("id", c_uint32), ("value", c_int32))


_READ, _WRITE = 2, 1


def _request(direction: int, number: int, argument: type[ctypes._CData]) -> int:
    return direction << 30 | ctypes.sizeof(argument) << 16 | ord("V") << 8 | number


QUERYCAP = _request(_READ, 0, Capability)
ENUM_FMT = _request(_READ | _WRITE, 2, FormatDescription)
S_FMT = _request(_READ | _WRITE, 5, Format)
REQBUFS = _request(_READ | _WRITE, 8, RequestBuffers)
QUERYBUF = _request(_READ | _WRITE, 9, Buffer)
QBUF = _request(_READ | _WRITE, 15, Buffer)
DQBUF = _request(_READ | _WRITE, 17, Buffer)
STREAMON = _request(_WRITE, 18, c_int32)
STREAMOFF = _request(_WRITE, 19, c_int32)
G_PARM = _request(_READ | _WRITE, 21, StreamParm)
S_PARM = _request(_READ | _WRITE, 22, StreamParm)
G_CTRL = _request(_READ | _WRITE, 27, Control)
S_CTRL = _request(_READ | _WRITE, 28, Control)
QUERYCTRL = _request(_READ | _WRITE, 36, QueryControl)
QUERYMENU = _request(_READ | _WRITE, 37, QueryMenu)
ENUM_FRAMESIZES = _request(_READ | _WRITE, 74, FrameSizeEnum)
ENUM_FRAMEINTERVALS = _request(_READ | _WRITE, 75, FrameIntervalEnum)

_NOT_OFFERED = (errno.EINVAL, errno.ENOTTY)


def ioctl(fd: int, request: int, argument: ctypes.Structure | c_int32) -> None:
    """The call, repeated if a signal cut it short. The argument is changed in place.

    Raises OSError.
    """
    while True:
        try:
            fcntl.ioctl(fd, request, argument, True)
        except InterruptedError:
            continue
        return


def is_offered(fd: int, request: int, argument: ctypes.Structure) -> bool:
    """`ioctl`, but False if the driver has no such call or nothing (more) to list."""
    try:
        ioctl(fd, request, argument)
    except OSError as error:
        if error.errno in _NOT_OFFERED:
            return False
        raise
    return True


def fourcc_of(code: int) -> str:
    """The four letters of a pixel format, as ``YUYV``, without the top bit (big-endian)."""
    return bytes(code >> shift & 0x7F for shift in (0, 8, 16, 24)).decode("ascii")


def code_of(fourcc: str) -> int:
    """The number of a pixel format."""
    return int.from_bytes(fourcc.encode("ascii"), "little")


def text_of(raw: bytes) -> str:
    """A name that a driver gave, without what would spoil a line."""
    return " ".join(raw.decode("utf-8", "replace").split())
