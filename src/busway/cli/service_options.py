"""Options that ``busway serve``, ``gateway`` and ``simulate`` have in common, and what these print at the start.

Knows options and the service that is built from them; knows neither servers nor gateways.

Once all listeners answer, their endpoints go to stdout, one per line, with the real ports; all else goes to stderr.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import typer

from .files import read_text
from .output import say, warn

if TYPE_CHECKING:
    from ..access.addresses import AddressList
    from ..access.rules import AccessRules
    from ..apps.service.service import Service
    from ..apps.service.service_interfaces import DeclaredServer
    from ..options.networks import Networks

NO_STANDARD_PORT = typer.Option(
    False, "--no-standard-port", help="Do not listen on 502 too where the network reaches another port."
)
POLICY = typer.Option(None, "--policy", metavar="FILE", help="Who may ask what: a policy file, or the word read-only.")
ALLOW_WRITES = typer.Option(False, "--allow-writes", help="Take writes from the network though there is no policy.")
ALLOW = typer.Option(
    None, "--allow", metavar="NET", help="Only these may connect: 10.0.0.0/8; several times if need be."
)
DENY = typer.Option(None, "--deny", metavar="NET", help="These may not connect.")
PRIORITY = typer.Option(
    None, "--priority", metavar="NET", help="Close a connection of these only for another one of these."
)
AUDIT = typer.Option(None, "--audit", metavar="FILE", help="Append denied requests and writes here.")


def _place_of_metrics(text: str | None) -> str | None:
    """Check the text of ``--metrics``, ``HOST:PORT``, and return it unchanged; None if the option is not given.

    Raises:
        ConfigError: the text has another form.
    """
    if text is not None:
        from ..options.text import host_and_port

        host_and_port(text, "--metrics")
    return text


METRICS = typer.Option(
    None,
    "--metrics",
    metavar="HOST:PORT",
    help="Offer metrics to Prometheus here: 127.0.0.1:9502.",
    callback=_place_of_metrics,
)
CONTROL = typer.Option(
    None,
    "--control",
    metavar="PATH",
    help="The socket that `busway status` asks, instead of the usual one; or off.",
)

READ_ONLY = "read-only"
"""The word that ``--policy`` takes instead of a file: all reads are permitted, and no writes."""


def address_list(allow: list[str] | None, deny: list[str] | None) -> "AddressList | None":
    """Return the address list that ``--allow`` and ``--deny`` describe; None if neither is given.

    Raises:
        ConfigError: an address or network is invalid; the error names the option.
    """
    from ..access.addresses import AddressList
    from ..options.networks import Networks

    if not allow and not deny:
        return None
    return AddressList(Networks(allow, key="--allow") if allow else None, Networks(deny or (), key="--deny"))


def priority_networks(priority: list[str] | None) -> "Networks | None":
    """Return the hosts and networks of ``--priority``; None if it is not given.

    Raises:
        ConfigError: a host or network is invalid; the error names the option.
    """
    from ..options.networks import Networks

    return Networks(priority, key="--priority") if priority else None


def access_rules(policy: str | None) -> "Callable[[DeclaredServer], AccessRules | None]":
    """Return a function that takes a configuration and returns the access rules to use; called at each reload, too.

    Args:
        policy: text of ``--policy``: a file, which the function reads each time, or ``read-only``; None for the rules
            that the configuration has. The function returns None if the configuration has none, and raises
            `ConfigError` if the policy file is invalid.
    """
    from ..apps.service.overrides import declared_rules

    if policy is None:
        return declared_rules

    def read(configuration: "DeclaredServer") -> "AccessRules":
        from ..access.addresses import AddressList
        from ..access.rules import AccessRules, Policy
        from ..config.files.policy import parse_policy_file

        if policy == READ_ONLY:
            return AccessRules(Policy.read_only(), AddressList())
        return parse_policy_file(read_text(policy), policy)

    return read


def is_file(policy: str | None) -> bool:
    """Whether the text of ``--policy`` is the path of a file, so that a reload has something to read."""
    return policy not in (None, READ_ONLY)


def announce(service: "Service") -> None:
    """Print the endpoints of a running service on stdout; read-only listeners and the place of metrics on stderr."""
    if service.read_only:
        warn(f"read-only, for want of a policy: {', '.join(service.read_only)}; --allow-writes takes writes")
    if service.metrics:
        say(f"metrics on {service.metrics}")
    for endpoint in service.server.endpoints:
        print(endpoint, flush=True)
