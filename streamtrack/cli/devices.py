"""`streamtrack devices`."""

from __future__ import annotations

import json
import shlex
from typing import TYPE_CHECKING, Annotated

import typer

from streamtrack.cli.common import consoles

if TYPE_CHECKING:
    from rich.console import Console

    from streamtrack.devices import Device


def devices(
    as_json: Annotated[bool, typer.Option("--json", help="As JSON, with controls.")] = False,
    controls: Annotated[
        bool, typer.Option("--controls", help="List what control.NAME=VALUE can set, too.")
    ] = False,
) -> None:
    """List the cameras of this machine and how to address them."""
    from streamtrack.devices import find_devices, to_json

    found = find_devices()
    if as_json:
        typer.echo(json.dumps(to_json(found), indent=2))
        return
    console, _ = consoles()
    if not found:
        typer.echo(
            "no cameras found: plug one in; it appears as /dev/video0 "
            "(in a container, pass it in: --device /dev/video0)"
        )
    for number, device in enumerate(found):
        if number:
            typer.echo()
        _print_device(console, device, controls)


def _print_device(console: Console, device: Device, with_controls: bool) -> None:
    from streamtrack.devices import sizes_and_rates

    origin = ", ".join(filter(None, [device.driver, device.bus]))
    typer.echo(f"{device.path}  {device.name}" + (f" ({origin})" if origin else ""))
    if device.stable_path is not None:
        typer.echo(f"  always {device.stable_path}")
    if device.problem:
        typer.echo(f"  problem: {device.problem}")
    typer.echo(f"  use    {shlex.quote(device.uri)}")
    _print_table(console, ("format", "size", "fps"), sizes_and_rates(device))
    if device.unreadable_formats:
        typer.echo(f"  also {', '.join(device.unreadable_formats)}, which are not read")
    if with_controls:
        rows = [
            (f"control.{control.name}", control.choices, f"default {control.default}")
            for control in device.controls
        ]
        _print_table(console, ("control", "values", ""), rows)


def _print_table(
    console: Console, titles: tuple[str, ...], rows: list[tuple[str, str, str]]
) -> None:
    from rich.table import Table
    from rich.text import Text

    if not rows:
        return
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for title in titles:
        table.add_column(title)
    for row in rows:
        table.add_row(*map(Text, row))
    with console.capture() as capture:
        console.print(table)
    for line in capture.get().splitlines():
        typer.echo(f"  {line.rstrip()}")
