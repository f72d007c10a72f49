"""Command-line overrides of a configuration: other listeners, a policy file, an audit log, addresses of services.

Knows what a command can override, and decides for each such option whether command line or file counts; knows neither
the texts of command-line options nor a server.

``priority`` replaces an option of each listener, so it is merged where the file is read (`listener_options`): there it
is checked with the other options.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from ...access.addresses import AddressList
from ...access.rules import AccessRules
from ...options.networks import Networks
from ...server.listener import Listener
from ..control.addresses import OFF
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
        priority: the networks of the priority hosts of every listener; None to use the file's.
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
    priority: Networks | None = None
    audit: str | None = None
    metrics: str | None = None
    control: str | None = None
    standard_port: bool | None = None
    can_reload: bool = False
    name: str = "server"

    @property
    def listener_options(self) -> dict[str, Any]:  # of several types
        """Options of all listeners, by name, that replace the file's: ``changes`` of `load_configuration`."""
        return {} if self.priority is None else {"priority": self.priority}

    @property
    def server_options(self) -> dict[str, Any]:  # as `busway.serve` takes them
        """Options of the whole server, by name, that replace the file's; ``priority`` is not among them."""
        return {} if self.standard_port is None else {"standard_port": self.standard_port}

    def listeners_of(self, configuration: DeclaredServer) -> list[Listener]:
        """Return the listeners to serve: those of the command line, without options of their own, or else the file's.

        Args:
            configuration: what the file declares.
        """
        return [Listener(url) for url in self.listen] or list(configuration.listeners)

    def audit_at(self, configuration: DeclaredServer) -> str | None:
        """Return the path of the audit log for a configuration; None for no log."""
        return self.audit or configuration.audit

    def metrics_at(self, configuration: DeclaredServer) -> str | None:
        """Return host and port on which the metrics are offered; None if they are not offered."""
        return self.metrics or configuration.file.metrics_address

    def control_at(self, configuration: DeclaredServer) -> str | None:
        """Return the path or address of the control socket: ``off`` for no socket, None for the default path.

        A path on the command line counts even if the file switches the control socket off.
        """
        is_on = configuration.file.control_parameters.enabled
        return self.control or (configuration.control if is_on else OFF)
