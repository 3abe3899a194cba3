"""The command line, one file a command.

Heavy modules are imported where they are used, so that --help is instant.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

from streamtrack.cli.options import Command, Group, run_command
from streamtrack.cli.process import hide_secrets
from streamtrack.errors import StreamtrackError, UsageError

_LIVE_ADDRESS = re.compile(r"(\S*:)?\d+")


def _in(module: str, name: str) -> Callable[[], Command | Group]:
    """Loads a command only when it is called, or listed."""

    def load() -> Command | Group:
        command: Command | Group = getattr(import_module(f"streamtrack.cli.{module}"), name)
        return command

    return load


_PROGRAM = Group(
    "Track objects in video, build mosaics of what the camera saw; see why in Rerun. "
    "--version prints the version.",
    {
        "track": _in("track", "track"),
        "mosaic": _in("mosaic", "mosaic"),
        "devices": _in("devices", "devices"),
        "synth": _in("tools", "synth"),
        "view": _in("tools", "view"),
        "bench": _in("bench", "bench"),
    },
)

__all__ = ["exit_on_error", "main", "with_live_address"]


def main() -> None:
    """Run the program."""
    # Rerun's own log lines: what matters of them is said in ours, in one line.
    os.environ.setdefault("RUST_LOG", "off")
    # Its allocator shall hand memory back at once: runs last for weeks.
    os.environ.setdefault("MIMALLOC_PURGE_DELAY", "0")
    # Its matrices are small: threads for them only wait for each other, at full speed.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    hide_secrets(sys.argv)
    exit_on_error(lambda: _run(sys.argv[1:]))


def _run(arguments: list[str]) -> int | None:
    if arguments[:1] == ["--version"]:
        from importlib.metadata import version

        sys.stdout.write(f"streamtrack {version('streamtrack')}\n")
        return 0
    return run_command("streamtrack", _PROGRAM, with_live_address(arguments))


def with_live_address(arguments: list[str]) -> list[str]:
    """The arguments with ``--live`` given its default where no address follows it.

    An option whose value may be left out would else take the source for it.
    """
    given: list[str] = []
    for place, argument in enumerate(arguments):
        following = arguments[place + 1] if place + 1 < len(arguments) else ""
        has_address = _LIVE_ADDRESS.fullmatch(following) is not None
        given.append("--live=" if argument == "--live" and not has_address else argument)
    return given


def exit_on_error(run: Callable[[], Any]) -> None:
    """Call ``run``; exit with 2 for wrong usage and 1 for any failure, each said in one line."""
    try:
        result = run()
        sys.stdout.flush()
        if isinstance(result, int):
            sys.exit(result)
    except UsageError as error:
        _fail(error, 2)
    except StreamtrackError as error:
        _fail(error, 1)
    except KeyboardInterrupt:
        _fail("interrupted", 1)
    except BrokenPipeError:
        # Nobody reads our output any more; keep Python from complaining while it shuts down.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _fail(message: object, code: int) -> None:
    sys.stderr.write(f"streamtrack: error: {message}\n")
    sys.exit(code)
