"""The command line, one file a command; the only package that talks to Typer.

Heavy modules are imported where they are used, so that --help is instant.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterable
from typing import Annotated, Any

import typer

from streamtrack.cli.bench import bench_app
from streamtrack.cli.devices import devices
from streamtrack.cli.mosaic import mosaic
from streamtrack.cli.process import hide_secrets
from streamtrack.cli.tools import synth, view
from streamtrack.cli.track import track
from streamtrack.errors import StreamtrackError, UsageError

_TYPER_INTERRUPTED = 130  # what Typer returns for a Ctrl-C, without a word
_LIVE_ADDRESS = re.compile(r"(\S*:)?\d+")

__all__ = ["app", "exit_on_error", "main", "with_live_address"]

_COMMANDS: tuple[Callable[..., None], ...] = (track, mosaic, devices, synth, view)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"streamtrack {version('streamtrack')}")
        raise typer.Exit


def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Track objects in video, build mosaics of what the camera saw; see why in Rerun."""


def _program(commands: Iterable[Callable[..., None]]) -> typer.Typer:
    """The program with these commands and ``bench``."""
    program = typer.Typer(
        name="streamtrack",
        help="Track objects in video, build mosaics of what the camera saw; see why in Rerun.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    program.callback()(_common)
    for command in commands:
        program.command()(command)
    program.add_typer(bench_app, name="bench")
    return program


app = _program(_COMMANDS)


def main() -> None:
    """Run the program."""
    # Rerun's own log lines: what matters of them is said in ours, in one line.
    os.environ.setdefault("RUST_LOG", "off")
    # Its allocator shall hand memory back at once: runs last for weeks.
    os.environ.setdefault("MIMALLOC_PURGE_DELAY", "0")
    # Its matrices are small: threads for them only wait for each other, at full speed.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    hide_secrets(sys.argv)
    # Nothing plugs into pydantic here, and looking for it reads every installed package's metadata.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    # Where one command is called, Typer need not work out the options of all the others.
    called = [command for command in _COMMANDS if [command.__name__] == sys.argv[1:2]]
    program = _program(called) if called else app
    exit_on_error(lambda: program(with_live_address(sys.argv[1:]), standalone_mode=False))


def with_live_address(arguments: list[str]) -> list[str]:
    """The arguments with ``--live`` given its default where no address follows it.

    Typer knows no options whose value may be left out.
    """
    given: list[str] = []
    for place, argument in enumerate(arguments):
        following = arguments[place + 1] if place + 1 < len(arguments) else ""
        has_address = _LIVE_ADDRESS.fullmatch(following) is not None
        given.append("--live=" if argument == "--live" and not has_address else argument)
    return given


def exit_on_error(run: Callable[[], Any]) -> None:
    """Call ``run``; exit with 2 for wrong usage and 1 for any failure, each said in one line."""
    from typer.exceptions import Abort, TyperException

    try:
        result = run()
        if result == _TYPER_INTERRUPTED:
            raise KeyboardInterrupt
        if isinstance(result, int):
            sys.exit(result)
    except TyperException as error:
        if not sys.argv[1:]:
            sys.stderr.write(f"{error.format_message()}\n")  # the help
            sys.exit(error.exit_code)
        _fail(f"{error.format_message().rstrip('.')}; see streamtrack --help", error.exit_code)
    except UsageError as error:
        _fail(error, 2)
    except StreamtrackError as error:
        _fail(error, 1)
    except (Abort, KeyboardInterrupt):
        _fail("interrupted", 1)
    except BrokenPipeError:
        # Nobody reads our output any more; keep Python from complaining while it shuts down.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _fail(message: object, code: int) -> None:
    sys.stderr.write(f"streamtrack: error: {message}\n")
    sys.exit(code)
