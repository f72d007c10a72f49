"""Command-line overrides of a configuration: other listeners, a policy file, an audit log, addresses of services.

Knows what a command can override; knows no option text and no server.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ...access.addresses import AddressList
from ...access.rules import AccessRules
from .interfaces import DeclaredServer


def declared_rules(configuration: DeclaredServer) -> AccessRules | None:
    """Return the access rules that the configuration file itself declares."""
    return configuration.access


@dataclass(frozen=True, slots=True)
class Overrides:
    """Command-line options that replace parts of a configuration.

    Attributes:
        listen: endpoints instead of those of the file.
        rules: gives the access rules; called again when files are read again.
        addresses: a list of who may connect, beside those of the file.
        allow_writes: whether listeners that the network reaches take writes without a policy.
        audit: path of the audit log.
        metrics: address on which the metrics are offered.
        control: path or address of the control socket, or ``off``.
        standard_port: whether port 502 is listened on beside others; None leaves it to the file.
        can_reload: whether there is something to be read again.
        name: name of the program, to tell several apart.
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
