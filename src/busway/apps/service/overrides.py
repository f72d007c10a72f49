"""Command-line overrides of a configuration: other listeners, a policy file, an audit log, addresses of services.

Knows what a command can override; knows neither the texts of command-line options nor a server.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ...access.addresses import AddressList
from ...access.rules import AccessRules
from .service_interfaces import DeclaredServer


def declared_rules(configuration: DeclaredServer) -> AccessRules | None:
    """Return the access rules that the configuration file itself declares; None if it has no policy."""
    return configuration.access


@dataclass(frozen=True, slots=True)
class Overrides:
    """Command-line options that replace parts of a configuration; the defaults leave everything to the file.

    Attributes:
        listen: endpoints instead of the file's; empty to use the file's.
        rules: function that returns the access rules for a configuration, None for no policy; called at each reload.
        addresses: a further list of hosts that may connect; a host must be allowed by this list and the file's. None
            for no further list.
        allow_writes: whether, without a policy, listeners that other hosts can reach accept writes.
        audit: path of the audit log; None to use the file's.
        metrics: host and port on which the metrics are offered; None to use the file's.
        control: path or address of the control socket, or ``off``; None to use the file's.
        standard_port: whether the server listens on port 502 beside other ports; None leaves it to the file.
        can_reload: whether `Service.reload` is offered, because there are files that can be read again.
        name: name of the program in its status, which tells several programs apart.
    """

    listen: Sequence[str] = ()
    rules: Callable[[DeclaredServer], AccessRules | None] = declared_rules
    addresses: AddressList | None = None
    allow_writes: bool = False
    audit: str | None = None
    metrics: str | None = None
    control: str | None = None
    standard_port: bool | None = None
    can_reload: bool = False
    name: str = "server"
