"""An overview of a configuration as rows of text: listeners, rights, links and units.

Knows a configuration; changes nothing.
"""

from collections.abc import Iterator

from ...access.addresses import AddressList
from ...codes import Table
from ...config.certificates import tls_of
from ...config.files.device import UnitSection
from ...options.declaration import NONE
from ...options.endpoints import parse_endpoint
from ...options.server import ListenerParameters
from ...server.listener import Listener
from ...values.counts import counted
from .configuration import Configuration
from .listeners_without_policy import reaches_network

OverviewRow = tuple[str, str, str]
"""One row of an overview: kind (such as ``listener`` or ``unit``), name and description."""


def overview(configuration: Configuration) -> Iterator[OverviewRow]:
    """Yield rows of text for listeners, policy, server, links and units of a configuration, in this order."""
    file = configuration.file
    for listener in configuration.listeners:
        yield "listener", str(listener.endpoint), "; ".join(_listener(listener, configuration.limits))
    yield "policy", "", _policy(configuration)
    yield "server", "", "; ".join(_server(configuration))
    for link in configuration.links.values():
        options = ", ".join(f"{name} {NONE if value is None else value}" for name, value in link.options.items())
        yield "link", link.name, f"{link.url}; {options or 'defaults'}"
    for section in file.unit:
        for number in section.unit:
            yield "unit", str(number), _unit(section)


def _listener(listener: Listener, general: ListenerParameters) -> Iterator[str]:
    carrier = parse_endpoint(listener.endpoint).carrier
    if carrier == "serial":
        yield "serial line"
        return
    if isinstance(listener.access, AddressList):
        yield from _addresses(listener.access)
    limits = listener.limits or general
    marked = f" for {', '.join(limits.priority)}" if limits.priority else ""
    yield f"{limits.max_priority_connections} priority slots{marked}, {limits.max_connections} others"
    tls = tls_of(listener)
    if tls is not None:
        yield f"certificate {tls.certificate}, authority {tls.authority}"
        if tls.require_role:
            yield "a role is required"
        if tls.revocation_list is not None:
            yield f"revocation list {tls.revocation_list}"


def _addresses(addresses: AddressList) -> Iterator[str]:
    if addresses.allow:
        yield f"allows {', '.join(addresses.allow)}"
    if addresses.deny:
        yield f"denies {', '.join(addresses.deny)}"
    if addresses.secure:
        yield "refuses all others"


def _policy(configuration: Configuration) -> str:
    access = configuration.access
    if access is None:
        exposed = any(reaches_network(str(listener.endpoint)) for listener in configuration.listeners)
        beyond = "; the command makes what the network reaches read-only" if exposed else ""
        return f"none: a client that may connect may do everything{beyond}"
    rules = access.policy.rules
    named = f"{counted(len(rules), 'rule')} ({', '.join(rule.name for rule in rules)}), else " if rules else ""
    return "; ".join((f"{named}{access.policy.default.value}", *_addresses(access.addresses)))


def _server(configuration: Configuration) -> Iterator[str]:
    yield f"audit {configuration.audit}" if configuration.audit else "no audit log"
    file = configuration.file
    yield f"metrics on {file.metrics_address}" if file.metrics else "no metrics"
    if not file.control_parameters.enabled:
        yield "no control socket"
    elif configuration.control:
        yield f"control socket {configuration.control}"
    else:
        yield "control socket in the usual place"


def _unit(section: UnitSection) -> str:
    parts = [section.name] if section.name else []
    for table in Table:
        declared = section.table(table)
        points = section.points_in(table)
        if declared is not None:
            parts.append(counted(declared.size, table.label))
        elif points:
            parts.append(counted(sum(point.size for point in points), table.label))
    parts.append(counted(len(section.placed), "point"))
    return ", ".join(parts)
