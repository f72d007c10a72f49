"""Interfaces of what a service runs (a server, a gateway or a simulation), and of the configuration that declares it.

Knows which methods a service and its reload call; knows no file and no listener.
"""

from collections.abc import Callable, Iterable, Sequence
from types import TracebackType
from typing import Any, Protocol

from ...access.rules import AccessRules, Policy
from ...config.files.system import SystemFile
from ...pdu.functions import FunctionTable
from ...server.listener import Listener
from ...session.server_pipeline import RequestObserver


class RunningServer(Protocol):
    """Interface of a running server, gateway or simulation, as a service and its reload use it."""

    @property
    def endpoints(self) -> list[str]:
        """URLs of the open listeners, with the ports that they are bound to; empty while stopped."""

    @property
    def is_running(self) -> bool:
        """Whether the server was started and is not stopped."""

    def status(self) -> Any:  # a dataclass, of its own kind
        """Return the current status, as a dataclass: `ServerStatus` of a server, `GatewayStatus` of a gateway."""

    @property
    def functions(self) -> FunctionTable:
        """The table of function codes, with their messages, that the server decodes."""

    def observe(self, observer: RequestObserver) -> None:
        """Register an observer of requests. Call this before the start."""

    def replace_policy(self, policy: Policy) -> None:
        """Use another access policy from the next request on; open connections stay."""

    def end_unauthorized(self) -> int:
        """Abort the connections of hosts that the address lists no longer allow; return their number."""

    def reload_security(self) -> None:
        """Read the TLS certificates again; they hold from the next connection on.

        Raises:
            ConfigError: a certificate cannot be used; that listener keeps its old ones.
        """

    async def __aenter__(self) -> object:
        """Start the server: open its listeners."""

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> bool | None:
        """Stop the server: close its listeners and connections."""


class DeclaredServer(Protocol):
    """Interface of a configuration that declares a server, a gateway or a simulation."""

    @property
    def file(self) -> SystemFile:
        """The sections of the configuration file, checked."""

    @property
    def listeners(self) -> tuple[Listener, ...]:
        """The listeners that the configuration declares."""

    @property
    def access(self) -> AccessRules | None:
        """The access rules that the configuration declares; None if it has no policy."""

    @property
    def audit(self) -> str | None:
        """Path of the audit log that the configuration declares; None without one."""

    @property
    def control(self) -> str | None:
        """Path or address of the control socket; None for the default one, or if the file switches it off.

        ``file.control_parameters.enabled`` tells which.
        """

    @property
    def at_once(self) -> frozenset[str]:
        """Names of the sections of the file whose changes a reload applies without a restart."""

    def serve(self, listen: Iterable[str | Listener] = (), **options: Any) -> RunningServer:  # of several types
        """Create the server that the configuration declares; it is not started yet.

        Args:
            listen: endpoints or listeners instead of the file's; empty to use the file's.
            options: options of `busway.serve` or `Gateway`, instead of the file's.
        """

    async def apply_to(
        self,
        running: Any,
        listen: Sequence[Listener],
        *,
        policy: Policy | None,
        when_applied: Callable[[Sequence[str]], None],
    ) -> list[str]:
        """Apply the configuration to a running server, as far as that is possible without a restart.

        Args:
            running: the server, created by `serve` of an earlier configuration.
            listen: the listeners that the server is to have from now on.
            policy: the access policy of new listeners; None for the policy of the existing ones.
            when_applied: called once with the result, in the step in which the configuration takes effect: it replaces
                the policy and the address lists. Not called if this method raises before.

        Returns:
            A text for each change; empty if nothing was changed.

        Raises:
            ModbusError: a part cannot be opened; the earlier configuration is in force again.
        """
