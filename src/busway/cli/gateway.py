"""``busway gateway``: forwards client requests to serial lines or other servers, until Ctrl-C or SIGTERM.

1. Once all listeners answer, their endpoints go to stdout, one per line, with the real ports; all else goes to stderr.
2. A listener that the network reaches is read-only unless there is a policy, or ``--allow-writes``.
3. SIGHUP reads the files again; unchanged parts keep their connections, and an invalid file changes nothing.
4. After the first SIGTERM or Ctrl-C, open requests have ``[gateway] drain`` seconds to be answered; the second ends the
   gateway at once.
5. ``check`` and ``--systemd-unit`` open no listener and no upstream.
"""

import asyncio
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ..errors import ConfigError
from ..values.counts import counted
from .arguments import CAPTURE, QUIET, VERBOSE, limits_of, seconds, show_traffic
from .exits import ExitCode
from .files import capturing
from .output import print_aligned, say, warn
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
    READ_ONLY,
    access_rules,
    address_list,
    announce,
    is_file,
    priority_networks,
)
from .signals import stop_events

if TYPE_CHECKING:
    from ..apps.gateway.configuration import GatewayConfiguration
    from ..apps.gateway.gateway import Gateway
    from ..apps.service.service import Service
    from .sd_notify import Manager

EXAMPLES = """\b
Examples:
  busway gateway tcp://:5020 "rtu:///dev/ttyUSB0?baud=19200"
  busway gateway tcp://:5020 udp://:5020 tcp://10.0.0.5
  busway gateway plant.toml --audit audit.jsonl
  busway gateway check plant.toml
  busway gateway --systemd-unit plant.toml > /etc/systemd/system/busway-gateway.service

URLs: where it listens, several if need be; the last one is the serial line or server that it forwards to.
A listener that the network reaches is read-only without a policy; --allow-writes lifts that.
"""

CHECK = "check"
_PATHS = frozenset({"--policy", "--audit", "--capture", "--control"})
"""Options whose values are paths. A systemd unit file gets them absolute, since a service runs in another folder."""


def gateway(
    what: list[str] = typer.Argument(
        ...,
        metavar="LISTENER... UPSTREAM | FILE | check FILE",
        help="URLs, the upstream last; or a gateway file, in TOML.",
    ),
    no_standard_port: bool = NO_STANDARD_PORT,
    policy: str | None = POLICY,
    allow_writes: bool = ALLOW_WRITES,
    allow: list[str] | None = ALLOW,
    deny: list[str] | None = DENY,
    priority: list[str] | None = PRIORITY,
    client_deadline: str | None = typer.Option(
        None,
        "--client-deadline",
        metavar="TIME",
        help="Answer each request within this time, with 0A or 0B at the latest: 2.5s. In a file it is a key.",
    ),
    audit: str | None = AUDIT,
    metrics: str | None = METRICS,
    control: str | None = CONTROL,
    systemd_unit: bool = typer.Option(
        False, "--systemd-unit", help="Print a unit file for systemd that runs this, and nothing else."
    ),
    capture: str | None = CAPTURE,
    verbose: int = VERBOSE,
    quiet: bool = QUIET,
) -> int:
    """Forward client requests to serial lines or other servers."""
    from ..apps.service.file_warnings import logging_warnings
    from ..apps.service.overrides import Overrides
    from ..apps.service.service import Service
    from ..server.loops import run

    if what[0] == CHECK:
        _check(what[1:])
        return ExitCode.DONE
    overrides = Overrides(
        rules=access_rules(policy),
        addresses=address_list(allow, deny),
        allow_writes=allow_writes,
        priority=priority_networks(priority),
        audit=audit,
        metrics=metrics,
        control=control,
        standard_port=False if no_standard_port else None,
        can_reload=not _is_url(what[0]) or is_file(policy),
        name="gateway",
    )
    read = _reader(what, overrides.listener_options, client_deadline)
    if systemd_unit:
        _print_unit(read(), sys.argv[1:], audit)
        return ExitCode.DONE
    read, drain = _remembering_drain(logging_warnings(read))
    service = Service(read, overrides)
    show_traffic(verbose)
    with capturing(capture):
        run(_serve(service, drain))
    return ExitCode.DONE


def _remembering_drain(
    read: "Callable[[], GatewayConfiguration]",
) -> "tuple[Callable[[], GatewayConfiguration], Callable[[], float]]":
    """Return two functions: ``read``, which now also stores the option ``drain``, and one that returns this option.

    The option is in seconds, of the configuration that was read last; 0.0 before the first.
    """
    seconds = 0.0

    def read_and_remember() -> "GatewayConfiguration":
        nonlocal seconds
        configuration = read()
        seconds = configuration.file.gateway.parameters().drain
        return configuration

    return read_and_remember, lambda: seconds


def _is_url(word: str) -> bool:
    return "://" in word


def _reader(words: list[str], changes: dict[str, Any], deadline: str | None) -> "Callable[[], GatewayConfiguration]":
    """Return a function that reads the gateway's configuration; it is called at the start and at each reload.

    Args:
        words: URLs of listeners, followed by the URL of the upstream; or the path of one file.
        changes: options of listeners that override those of the file.
        deadline: text of ``--client-deadline``, which is allowed with URLs only; None if it is not given.

    Raises:
        ConfigError: the words are neither several URLs nor one file, or the deadline is invalid.
    """
    from ..apps.gateway.configuration import load_gateway, simple_gateway
    from ..options.client import CLIENT_DEADLINE
    from ..options.gateway import GatewayListenerParameters

    files = [word for word in words if not _is_url(word)]
    if not files:
        if len(words) == 1:
            raise ConfigError(
                "add the URL of a serial line or server to forward to, for example rtu:///dev/ttyUSB0", key="UPSTREAM"
            )
        low, high = limits_of(GatewayListenerParameters, "client_deadline")
        within = CLIENT_DEADLINE if deadline is None else seconds(deadline, "--client-deadline", low=low, high=high)
        return lambda: simple_gateway(words[:-1], words[-1], changes=changes, client_deadline=within)
    if len(words) > 1:
        raise ConfigError(f"either URLs or one file, not {' '.join(words)}", key="FILE")
    if deadline is not None:
        raise ConfigError(
            "goes with URLs; in a file it is the key client_deadline of a listener", key="--client-deadline"
        )
    return lambda: load_gateway(files[0], changes=changes)


def _check(words: list[str]) -> None:
    if len(words) != 1:
        raise ConfigError("check needs one file", key="FILE")
    check_file(words[0])


def check_file(file: str) -> None:
    """Print listeners, upstreams and routes of a gateway file on stdout, without starting it; warnings go to stderr.

    Raises:
        ConfigError: the file is invalid, or names a file that cannot be used.
    """
    from ..apps.gateway.configuration import load_gateway
    from ..apps.gateway.overview import ROUTING_HEADINGS, gateway_rows, routing_rows

    configuration = load_gateway(file, preflight=True)
    print_aligned(list(gateway_rows(configuration)))
    print()
    print_aligned([ROUTING_HEADINGS, *routing_rows(configuration)])
    for warning in configuration.warnings:
        print(warning, file=sys.stderr)


def _print_unit(configuration: "GatewayConfiguration", words: list[str], audit: str | None) -> None:
    """Print a systemd unit file for the gateway.

    Args:
        configuration: the configuration of the gateway, from which the rights of the service follow.
        words: arguments of this command line, with which the service starts the gateway.
        audit: path of ``--audit``; None if it is not given.
    """
    from .systemd_unit import ServiceUnit, program

    is_file = configuration.name in words
    kept: list[str] = []
    for word in _separate(words):
        if word != "--systemd-unit":
            is_path = (is_file and word == configuration.name) or (bool(kept) and _is_path(kept[-1], word))
            kept.append(str(Path(word).absolute()) if is_path else word)
    log = audit or configuration.audit
    unit = ServiceUnit(
        command=[*program(), *kept],
        plan=configuration.plan,
        drain=configuration.file.gateway.parameters().drain,
        written=[] if log is None else [str(Path(log).absolute().parent)],
        name=Path(configuration.name).stem if is_file else "gateway",
    )
    sys.stdout.write(unit.text())


def _is_path(option: str, value: str) -> bool:
    """Whether the value of an option is a path; some options also take a word or a URL instead.

    Raises:
        ConfigError: the value of ``--control`` is invalid.
    """
    from ..apps.control.addresses import OFF, UnixAddress, parse_control_address

    if option == "--control":
        return value != OFF and isinstance(parse_control_address(value), UnixAddress)
    return option in _PATHS and value != READ_ONLY


def _separate(words: list[str]) -> list[str]:
    """Return command-line words with options that take a path separated from it: ``--audit=log`` is ``--audit log``.

    Other options stay as they are.
    """
    pairs = [(word, *word.partition("=")) for word in words]
    return [each for word, name, _, path in pairs for each in ((name, path) if name in _PATHS and path else (word,))]


async def _serve(service: "Service", drain: Callable[[], float]) -> None:
    from .sd_notify import Manager, watched

    manager = Manager()

    def told(is_over: bool) -> None:
        if is_over:
            manager.ready(_standing(_running(service)))
        else:
            manager.reloading()

    with stop_events() as (stop, at_once):
        async with read_again_on_hangup(service, told), service:
            announce(service)
            async with watched(manager):
                manager.ready(_standing(_running(service)))
                await stop.wait()
                await _drain(_running(service), drain(), at_once, manager)


def _running(service: "Service") -> "Gateway":
    from ..apps.gateway.gateway import Gateway

    assert isinstance(service.server, Gateway)
    return service.server


def _standing(gateway: "Gateway") -> str:
    """Return one line with the gateway's endpoints and upstreams, as status for the service manager (systemd)."""
    return f"{', '.join(gateway.endpoints)} to {', '.join(upstream.name for upstream in gateway.plan.upstreams)}"


async def _drain(gateway: "Gateway", seconds: float, at_once: asyncio.Event, manager: "Manager") -> None:
    """Let the gateway accept nothing more, and wait until it has answered the requests that it has received.

    Prints on stderr for how many requests it waits, and how many are left unanswered, if any.

    Args:
        gateway: the gateway.
        seconds: the longest wait, in seconds.
        at_once: ends the wait when it is set.
        manager: the service manager, which is told that the program stops.
    """
    waiting = gateway.open_requests
    manager.stopping(f"{counted(waiting, 'request')} to answer")
    if waiting:
        say(
            f"ends when {counted(waiting, 'request')} {'is' if waiting == 1 else 'are'} answered, "
            f"within {seconds:g} s; another signal ends it at once"
        )
    draining = asyncio.ensure_future(gateway.drain(seconds))
    hurried = asyncio.ensure_future(at_once.wait())
    await asyncio.wait({draining, hurried}, return_when=asyncio.FIRST_COMPLETED)
    left = draining.result() if draining.done() else gateway.open_requests
    draining.cancel()
    hurried.cancel()
    await asyncio.gather(draining, hurried, return_exceptions=True)
    if left:
        warn(f"left unanswered: {counted(left, 'request')}")
