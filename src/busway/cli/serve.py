"""``busway serve``: be a device, or several, until Ctrl-C or SIGTERM.

1. The endpoints go to stdout as they are bound, one per line, once all of them answer; everything else to stderr.
2. Without a file: unit 1 with 1000 items in each table, which also answers to 0 and 255, as the sole device does.
"""

import asyncio
from typing import TYPE_CHECKING

import typer

from .arguments import CAPTURE, VERBOSE, show_traffic
from .exits import ExitCode
from .files import capturing, read_device_file
from .output import say
from .signals import stop_event

if TYPE_CHECKING:
    from ..server.server import Server

EXAMPLES = """\b
Examples:
  busway serve
  busway serve --listen tcp://127.0.0.1:1502
  busway serve plant.toml -v

Without FILE, unit 1 has 1000 items in each table, and also answers to 0 and 255.
"""

ITEMS = 1000
"""Of each table without a file."""


def serve(
    file: str | None = typer.Argument(None, metavar="[FILE]", help="A device file, in TOML."),
    listen: list[str] | None = typer.Option(
        None, "--listen", metavar="URL", help="Listen here, and not where the file says; several times if need be."
    ),
    capture: str | None = CAPTURE,
    verbose: int = VERBOSE,
) -> int:
    """Be a device."""
    server = _server(file, listen or [])
    show_traffic(verbose)
    with capturing(capture):
        asyncio.run(_serve(server, file))
    return ExitCode.DONE


def _server(file: str | None, listen: list[str]) -> "Server":
    if file is not None:
        declared = read_device_file(file)
        from ..simulator.build import build_server

        return build_server(declared, listen)
    from ..server.device import Device
    from ..server.serving import serve as make_server

    device = Device(holding_registers=ITEMS, input_registers=ITEMS, coils=ITEMS, discrete_inputs=ITEMS)
    return make_server(*listen, units={1: device})


async def _serve(server: "Server", file: str | None) -> None:
    with stop_event() as stop:
        async with server:
            if file is None:
                say(f"unit 1 has {ITEMS} coils, discrete inputs, input registers and holding registers")
            for endpoint in server.endpoints:
                print(endpoint, flush=True)
            await stop.wait()
