"""``busway serve``: be a device, or several, until Ctrl-C or SIGTERM.

1. The endpoints go to stdout as they are bound, one per line, once all of them answer; everything else to stderr.
2. Without a file: unit 1 with 1000 items in each table, which also answers to 0 and 255, as the sole device does.
3. A listener that the network reaches is read-only unless there is a policy, or writes are allowed by name.
4. SIGHUP reads the files again; what can not be stays as it was, and that is said.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import typer

from ..errors import ModbusError
from .arguments import CAPTURE, VERBOSE, show_traffic
from .exits import ExitCode
from .files import capturing, read_text
from .output import say
from .signals import on_hangup, stop_event

if TYPE_CHECKING:
    from ..assembly.configuration import Configuration
    from ..assembly.service import Service
    from ..config.access.rules import AccessRules

EXAMPLES = """\b
Examples:
  busway serve
  busway serve --listen tcp://127.0.0.1:1502
  busway serve plant.toml -v
  busway serve plant.toml --listen tcp://:502 --policy policy.toml --audit audit.jsonl

Without FILE, unit 1 has 1000 items in each table, and also answers to 0 and 255.
A listener that the network reaches is read-only without a policy; --allow-writes lifts that.
"""

ITEMS = 1000
"""Of each table without a file."""
BUILT_IN = f"""\
[[unit]]
unit = 1
holding_registers = {ITEMS}
input_registers = {ITEMS}
coils = {ITEMS}
discrete_inputs = {ITEMS}
"""
READ_ONLY = "read-only"
"""The policy that needs no file."""


def serve(
    file: str | None = typer.Argument(None, metavar="[FILE]", help="A configuration or device file, in TOML."),
    listen: list[str] | None = typer.Option(
        None, "--listen", metavar="URL", help="Listen here, and not where the file says; several times if need be."
    ),
    no_standard_port: bool = typer.Option(
        False, "--no-standard-port", help="Do not listen on 502 too where the network reaches another port."
    ),
    policy: str | None = typer.Option(
        None, "--policy", metavar="FILE", help="Who may ask what: a policy file, or the word read-only."
    ),
    allow_writes: bool = typer.Option(
        False, "--allow-writes", help="Take writes from the network though there is no policy."
    ),
    allow: list[str] | None = typer.Option(
        None, "--allow", metavar="NET", help="Only these may connect: 10.0.0.0/8; several times if need be."
    ),
    deny: list[str] | None = typer.Option(None, "--deny", metavar="NET", help="These may not connect."),
    priority: list[str] | None = typer.Option(
        None, "--priority", metavar="NET", help="Never close a connection of these to make room."
    ),
    audit: str | None = typer.Option(None, "--audit", metavar="FILE", help="Append denied requests and writes here."),
    metrics: str | None = typer.Option(
        None, "--metrics", metavar="HOST:PORT", help="Offer metrics to Prometheus here: 127.0.0.1:9502."
    ),
    control: str | None = typer.Option(
        None,
        "--control",
        metavar="PATH",
        help="The socket that `busway status` asks, instead of the usual one; or off.",
    ),
    capture: str | None = CAPTURE,
    verbose: int = VERBOSE,
) -> int:
    """Be a device."""
    from ..assembly.service import Service, Wishes
    from ..config.access.addresses import AddressList
    from ..config.access.networks import Networks
    from ..server.loops import run

    addresses = None
    if allow or deny:
        addresses = AddressList(Networks(allow or (), key="--allow"), Networks(deny or (), key="--deny"))
    changes = {"priority": Networks(priority, key="--priority")} if priority else {}
    wishes = Wishes(
        listen=listen or (),
        rules=_rules(policy),
        addresses=addresses,
        allow_writes=allow_writes,
        audit=audit,
        metrics=metrics,
        control=control,
        standard_port=False if no_standard_port else None,
        can_reload=file is not None or policy not in (None, READ_ONLY),
    )
    service = Service(_reader(file, changes), wishes)
    show_traffic(verbose)
    with capturing(capture):
        run(_serve(service, file))
    return ExitCode.DONE


def _reader(file: str | None, changes: dict[str, Any]) -> "Callable[[], Configuration]":
    """What reads the configuration, now and whenever it is read again."""
    from ..assembly.configuration import load_configuration, parse_configuration

    if file is None:
        return lambda: parse_configuration(BUILT_IN, "busway serve", changes=changes)
    return lambda: load_configuration(file, changes=changes)


def _rules(policy: str | None) -> "Callable[[Configuration], AccessRules | None]":
    """What gives the access rules: those of the option, or else those of the configuration."""
    from ..assembly.service import declared_rules

    if policy is None:
        return declared_rules

    def read(configuration: "Configuration") -> "AccessRules":
        from ..config.access.addresses import AddressList
        from ..config.access.rules import AccessRules, Policy
        from ..config.files.policy import parse_policy_file

        if policy == READ_ONLY:
            return AccessRules(Policy.read_only(), AddressList())
        return parse_policy_file(read_text(policy), policy)

    return read


async def _serve(service: "Service", file: str | None) -> None:
    with stop_event() as stop, on_hangup(lambda: _reload(service)):
        async with service:
            if file is None:
                say(f"unit 1 has {ITEMS} coils, discrete inputs, input registers and holding registers")
            if service.read_only:
                say(f"read-only, for want of a policy: {', '.join(service.read_only)}; --allow-writes takes writes")
            if service.metrics:
                say(f"metrics on {service.metrics}")
            for endpoint in service.server.endpoints:
                print(endpoint, flush=True)
            await stop.wait()


def _reload(service: "Service") -> None:
    """Read the files again, and say what came of it."""
    try:
        done = service.reload()
    except ModbusError as error:
        say(f"read again, nothing was changed:\n{error}")
    else:
        say(f"read again: {'; '.join(done)}")
