"""Commands as functions: their annotated parameters are the arguments and options.

    def devices(as_json: Annotated[bool, Option("--json", help="As JSON.")] = False) -> None: ...

Parsed by argparse of the standard library: Typer took a third of a second to import and to work
out one command's options.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, NoReturn, get_args, get_origin, get_type_hints

from streamtrack.errors import UsageError, unknown_name

Command = Callable[..., int | None]

_KINDS = {float: "NUMBER", int: "N", Path: "FILE", str: "TEXT"}


@dataclass(frozen=True)
class Argument:
    """A parameter that is given by its place; a list takes one or more."""

    metavar: str
    help: str


class Option:
    """A parameter that is given by a name, ``--its-name`` unless others are given.

    A list may be given repeatedly, a bool takes no value. ``least`` is the smallest number taken.
    """

    def __init__(
        self,
        *names: str,
        help: str,  # noqa: A002
        metavar: str | None = None,
        least: int | None = None,
    ) -> None:
        self.names, self.help, self.metavar, self.least = names, help, metavar, least


@dataclass(frozen=True)
class Group:
    """What loads each command by its name, and what the commands have in common."""

    help: str
    commands: Mapping[str, Callable[[], Command | Group]]


def run_command(program: str, command: Command | Group, arguments: Sequence[str]) -> int | None:
    """Call the command, or the one of a group, that the arguments ask for; its exit code.

    Prints help where it is asked for, or where a group is given no command. Raises UsageError for
    arguments that the command does not take.
    """
    if not isinstance(command, Group):
        parser = _parser(program, command)
        # Argparse cannot have both: options anywhere, and -- in front of names that look like one.
        parse = parser.parse_args if "--" in arguments else parser.parse_intermixed_args
        return command(**vars(parse(list(arguments))))
    name = arguments[0] if arguments else ""
    if name in ("", "--help", "-h"):
        (sys.stdout if name else sys.stderr).write(_group_help(program, command))
        return 0 if name else 2
    if name not in command.commands:
        raise unknown_name("command", name, command.commands)
    return run_command(f"{program} {name}", command.commands[name](), arguments[1:])


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}; see {self.prog} --help")


def _parser(program: str, command: Command) -> argparse.ArgumentParser:
    parser = _Parser(
        program, description=inspect.getdoc(command), allow_abbrev=False, formatter_class=_Formatter
    )
    # What begins like a negative number is a value: --target -5,10,100,80.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    places: list[str] = []
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        annotation, spec = get_args(hints[name])
        _add(parser, name, annotation, spec, parameter.default)
        if isinstance(spec, Argument):
            places.append(spec.metavar)
    parser.usage = " ".join([program, "[options]", *places])
    return parser


class _Formatter(argparse.HelpFormatter):
    def __init__(self, prog: str) -> None:
        # With a width, for argparse makes a formatter for each option and asks the terminal again.
        super().__init__(prog, max_help_position=30, width=78)


def _add(
    parser: argparse.ArgumentParser, name: str, annotation: Any, spec: Any, default: Any
) -> None:
    kind = next(k for k in (get_args(annotation) or (annotation,)) if k is not NoneType)
    is_list = get_origin(annotation) is list or get_origin(kind) is list
    kind = get_args(kind)[0] if get_origin(kind) is list else kind
    if isinstance(spec, Argument):
        count = "+" if is_list else None
        parser.add_argument(name, metavar=spec.metavar, help=spec.help, type=kind, nargs=count)
        return
    more: dict[str, Any] = {"dest": name, "help": spec.help, "default": default}
    if isinstance(default, int) and kind is int:
        more["help"] += f" Default {default}."
    if kind is bool:
        more["action"] = "store_true"
    else:
        more["metavar"] = spec.metavar or _KINDS[kind]
        more["type"] = _converter(kind, spec.least)
    if is_list:
        more["action"] = "append"
    if default is inspect.Parameter.empty:
        more |= {"required": True, "default": None}
    own = f"--{name.replace('_', '-')}"
    parser.add_argument(*(spec.names or (own,)), **more)


def _converter(kind: type, least: int | None) -> Callable[[str], Any]:
    def convert(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            wanted = "whole number" if kind is int else "number"
            raise argparse.ArgumentTypeError(f"'{text}' is no {wanted}") from None
        if least is not None and value < least:
            raise argparse.ArgumentTypeError(f"{text} is less than {least}")
        return value

    return convert


def _group_help(program: str, group: Group) -> str:
    width = max(map(len, group.commands)) + 2
    lines = [f"usage: {program} COMMAND ...", "", *textwrap.wrap(group.help, 78), "", "commands:"]
    for name, load in group.commands.items():
        command = load()
        about = command.help if isinstance(command, Group) else inspect.getdoc(command) or ""
        lines += textwrap.wrap(
            about,
            78,
            initial_indent=f"  {name:<{width}}",
            subsequent_indent=" " * (width + 2),
        )
    return "\n".join([*lines, "", f"{program} COMMAND --help says more."]) + "\n"
