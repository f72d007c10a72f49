"""Interfaces of what a service runs (a server, a gateway or a simulation), and of the configuration that declares it.

Knows what is asked of both; knows no file and no listener.
"""

from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import Any, Protocol

from ...access.rules import AccessRules, Policy
from ...config.files.system import SystemFile
from ...pdu.functions import FunctionTable
from ...server.listener import Listener
from ...session.pipeline import RequestObserver


class RunningServer(Protocol):
    """Interface of a server or gateway that `busway serve` or `gateway` runs."""

    @property
    def endpoints(self) -> list[str]:
        """URLs of the listeners with their bound addresses and ports."""

    @property
    def is_running(self) -> bool:
        """Whether the server was started and not stopped."""

    def status(self) -> Any:  # a dataclass, of its own kind
        """Return the current status of the server or gateway."""

    @property
    def functions(self) -> FunctionTable:
        """The table of function codes, with their messages, that the server decodes."""

    def observe(self, observer: RequestObserver) -> None:
        """Register an observer of the server's requests, before the start."""

    def replace_policy(self, policy: Policy) -> None:
        """Use another access policy, from the next request on."""

    def end_unauthorized(self) -> int:
        """Abort connections of hosts that may no longer connect; returns their number."""

    def reload_security(self) -> None:
        """Read the TLS certificates again. Raises `ConfigError`; a listener keeps its old ones if they are unusable."""

    async def __aenter__(self) -> object:
        """Open the listeners of the server."""

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> bool | None:
        """Close the listeners of the server."""


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
        """The access rules of the configuration; None without any."""

    @property
    def audit(self) -> str | None:
        """Path of the audit log that the configuration declares; None without one."""

    @property
    def control(self) -> str | None:
        """Address of the control socket; None for the default one."""

    @property
    def at_once(self) -> frozenset[str]:
        """Names of the file's sections that a reload applies without a restart."""

    def serve(self, listen: Iterable[str | Listener] = (), **options: Any) -> RunningServer:  # of several types
        """Create the server that the configuration declares, not started yet."""

    async def apply_to(self, running: Any, listen: Sequence[Listener], *, policy: Policy | None) -> list[str]:
        """Apply the configuration to a running server, as far as possible without a restart. Raises `ModbusError`."""
