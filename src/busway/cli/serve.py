"""``busway serve``: serves one or several devices, until Ctrl-C or SIGTERM.

1. Once all listeners answer, their endpoints go to stdout, one per line, with the real ports; all else goes to stderr.
2. Without a file: unit 1 with 1000 items in each table, which also answers to 0 and 255, as the sole device does.
3. A listener that the network reaches is read-only unless there is a policy, or ``--allow-writes``.
4. SIGHUP reads the files again; on an error the old settings stay and the error is printed.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import typer

from ..errors import ConfigError
from .arguments import (
    CAPTURE,
    QUIET,
    UNIT_OF_FILE,
    VERBOSE,
    hint_at_unit,
    refuse_other_unit,
    show_traffic,
    unit_number,
)
from .exits import ExitCode
from .files import capturing
from .output import say
from .reload_on_sighup import read_again_on_hangup
from .service_options import (
    ALLOW,
    ALLOW_WRITES,
    AUDIT,
    CONTROL,
    DENY,
    METRICS,
    NO_STANDARD_PORT,
    POLICY,
    PRIORITY,
    access_rules,
    address_list,
    announce,
    is_file,
    priority_networks,
)
from .signals import stop_event

if TYPE_CHECKING:
    from ..apps.service.configuration import Configuration
    from ..apps.service.service import Service

EXAMPLES = """\b
Examples:
  busway serve
  busway serve --listen tcp://127.0.0.1:1502
  busway serve plant.toml -v
  busway serve meter.toml --unit 7
  busway serve plant.toml --listen tcp://:502 --policy policy.toml --audit audit.jsonl

Without FILE, unit 1 has 1000 items in each table, and also answers to 0 and 255.
A listener that the network reaches is read-only without a policy; --allow-writes lifts that.
"""

ITEMS = 1000
"""Number of items in each table of the unit that is served without a file."""
BUILT_IN = f"""\
[[unit]]
holding_registers = {ITEMS}
input_registers = {ITEMS}
coils = {ITEMS}
discrete_inputs = {ITEMS}
"""


def serve(
    file: str | None = typer.Argument(None, metavar="[FILE]", help="A configuration or device file, in TOML."),
    listen: list[str] | None = typer.Option(
        None, "--listen", metavar="URL", help="Listen here, and not where the file says; several times if need be."
    ),
    unit: str | None = UNIT_OF_FILE,
    no_standard_port: bool = NO_STANDARD_PORT,
    policy: str | None = POLICY,
    allow_writes: bool = ALLOW_WRITES,
    allow: list[str] | None = ALLOW,
    deny: list[str] | None = DENY,
    priority: list[str] | None = PRIORITY,
    audit: str | None = AUDIT,
    metrics: str | None = METRICS,
    control: str | None = CONTROL,
    capture: str | None = CAPTURE,
    verbose: int = VERBOSE,
    quiet: bool = QUIET,
) -> int:
    """Serve one or several devices over Modbus."""
    from ..apps.service.file_warnings import logging_warnings
    from ..apps.service.overrides import Overrides
    from ..apps.service.service import Service
    from ..server.loops import run

    overrides = Overrides(
        listen=listen or (),
        rules=access_rules(policy),
        addresses=address_list(allow, deny),
        allow_writes=allow_writes,
        priority=priority_networks(priority),
        audit=audit,
        metrics=metrics,
        control=control,
        standard_port=False if no_standard_port else None,
        can_reload=file is not None or is_file(policy),
    )
    number = unit_number(unit)
    service = Service(logging_warnings(_reader(file, number, overrides.listener_options)), overrides)
    show_traffic(verbose)
    with capturing(capture):
        run(_serve(service, file, 1 if number is None else number))
    return ExitCode.DONE


def _reader(file: str | None, unit: int | None, changes: dict[str, Any]) -> "Callable[[], Configuration]":
    """Return a function that reads the server's configuration; it is called at the start and at each reload.

    Args:
        file: path of a configuration or device file; None for a unit with `ITEMS` items in each table.
        unit: number given by ``--unit``, for a unit without a number; None if it is not given.
        changes: options of listeners that override those of the file.

    Raises:
        ConfigError: ``file`` is a URL. The returned function raises it if the file is invalid, or if ``unit`` is given
            and the file has other units only.
    """
    from ..apps.service.configuration import parse_configuration
    from ..config.file_text import read_text

    if file is None:
        number = 1 if unit is None else unit
        return lambda: parse_configuration(BUILT_IN, "busway serve", changes=changes, unit=number)
    if "://" in file:
        raise ConfigError(f"is a file; where to listen is said by --listen {file}", key="FILE")

    def read() -> "Configuration":
        with hint_at_unit():
            found = parse_configuration(read_text(file), file, changes=changes, unit=unit)
        refuse_other_unit(file, unit, (number for section in found.file.unit for number in section.unit))
        return found

    return read


async def _serve(service: "Service", file: str | None, unit: int) -> None:
    with stop_event() as stop:
        async with read_again_on_hangup(service), service:
            if file is None:
                say(f"unit {unit} has {ITEMS} coils, discrete inputs, input registers and holding registers")
            announce(service)
            await stop.wait()
