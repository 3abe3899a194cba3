"""Commands from annotated functions: what they are called with, and one line where they are not."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import pytest

from streamtrack.cli.options import Argument, Group, Option, run_command
from streamtrack.errors import UsageError

CALLS: list[dict[str, Any]] = []


def command(
    inputs: Annotated[list[str], Argument(metavar="INPUT", help="Inputs.")],
    target: Annotated[list[str] | None, Option(help="May repeat.")] = None,
    output: Annotated[Path | None, Option("--output", "-o", help="A file.")] = None,
    max_width: Annotated[int | None, Option(least=32, help="A width.")] = None,
    step: Annotated[int, Option(least=1, help="A step.")] = 1,
    scale: Annotated[float | None, Option(help="A scale.")] = None,
    quiet: Annotated[bool, Option("--quiet", "-q", help="Silent.")] = False,
) -> int:
    """Do a thing."""
    CALLS.append(locals())
    return 3


PROGRAM = Group("A program.", {"command": lambda: command})


@pytest.mark.parametrize(
    ("arguments", "given"),
    [
        ("a b", {"inputs": ["a", "b"], "step": 1, "quiet": False, "target": None}),
        ("a -o m.png b -q", {"inputs": ["a", "b"], "output": Path("m.png"), "quiet": True}),
        ("a --target -5,10,20,20 --target=x", {"target": ["-5,10,20,20", "x"]}),
        ("a --target -.5,1,2,3", {"target": ["-.5,1,2,3"]}),
        ("- --max-width 32 --scale -1e3", {"inputs": ["-"], "max_width": 32, "scale": -1000.0}),
        ("--step 2 --step 3 -- -a", {"inputs": ["-a"], "step": 3}),
    ],
)
def test_a_command_gets_what_is_given(arguments: str, given: dict[str, Any]) -> None:
    assert run_command("p", PROGRAM, ["command", *arguments.split()]) == 3
    assert given.items() <= CALLS[-1].items()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("command", "INPUT"),
        ("command a --step", "expected one argument"),
        ("command a --step 0", "--step: 0 is less than 1"),
        ("command a --step 1.5", "'1.5' is no whole number"),
        ("command a --scale wide", "'wide' is no number"),
        ("command a --qui", "unrecognized arguments: --qui"),
        ("comand a", "did you mean command?"),
    ],
)
def test_what_it_does_not_take_is_one_line(arguments: str, message: str) -> None:
    with pytest.raises(UsageError) as refused:
        run_command("p", PROGRAM, arguments.split())
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_help_names_commands_and_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command("p", PROGRAM, ["--help"]) == 0
    assert "Do a thing." in capsys.readouterr().out
    with pytest.raises(SystemExit) as ended:
        run_command("p", PROGRAM, ["command", "--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert "usage: p command [options] INPUT" in shown
    assert "--max-width" in shown and "Default 1." in shown
    assert run_command("p", PROGRAM, []) == 2
    assert "Do a thing." in capsys.readouterr().err
