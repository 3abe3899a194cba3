"""The command line, one file a command; the only package that talks to Typer.

Commands are loaded when they are called, and heavy modules where they are used, so that --help is
instant and no command pays for another.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from streamtrack.cli.process import hide_secrets
from streamtrack.errors import StreamtrackError, UsageError

_TYPER_INTERRUPTED = 130  # what Typer returns for a Ctrl-C, without a word
_LIVE_ADDRESS = re.compile(r"(\S*:)?\d+")

__all__ = ["exit_on_error", "main", "with_live_address"]

_HOMES = {
    "track": "track",
    "mosaic": "mosaic",
    "devices": "devices",
    "synth": "tools",
    "view": "tools",
    "bench": "bench",
}
"""The module of each command, in the order of the help."""


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


def _program(commands: Iterable[str]) -> typer.Typer:
    """The program with these commands."""
    program = typer.Typer(
        name="streamtrack",
        help="Track objects in video, build mosaics of what the camera saw; see why in Rerun.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    program.callback()(_common)
    for name in commands:
        command = getattr(import_module(f"streamtrack.cli.{_HOMES[name]}"), name)
        if isinstance(command, typer.Typer):
            program.add_typer(command, name=name)
        else:
            program.command()(command)
    return program


def main() -> None:
    """Run the program."""
    if sys.stdout is None or sys.stderr is None:  # closed by the shell: >&- 2>&-
        nowhere = Path(os.devnull).open("w")  # noqa: SIM115
        sys.stdout, sys.stderr = sys.stdout or nowhere, sys.stderr or nowhere
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
    called = [name for name in _HOMES if [name] == sys.argv[1:2]]
    arguments = with_live_address(sys.argv[1:])
    exit_on_error(lambda: _program(called or _HOMES)(arguments, standalone_mode=False))


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
        message = error.format_message()
        if message.startswith("Usage:"):  # the help, of the program or of `bench`
            sys.stderr.write(f"{message}\n")
            sys.exit(error.exit_code)
        _fail(f"{message.rstrip('.')}; see streamtrack --help", error.exit_code)
    except UsageError as error:
        _fail(error, 2)
    except StreamtrackError as error:
        _fail(error, 1)
    except (Abort, KeyboardInterrupt):
        _fail("interrupted", 1)
    except BrokenPipeError:  # nobody reads our output any more
        _drop_output()
        sys.exit(1)
    except OSError as error:
        _drop_output()
        reason = (error.strerror or str(error)).lower()
        _fail(f"cannot go on: {reason}; check the disks and where the output goes", 1)


def _drop_output() -> None:
    """Keep Python from complaining of what it cannot write while it shuts down."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: object, code: int) -> None:
    sys.stderr.write(f"streamtrack: error: {message}\n")
    sys.exit(code)
