"""What a service runs, and what declares it: a server, a gateway or a simulation.

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
    """What runs: a server, or a gateway."""

    @property
    def endpoints(self) -> list[str]:
        """URLs of the listeners as they are bound."""

    @property
    def is_running(self) -> bool:
        """Whether it answers."""

    def status(self) -> Any:  # a dataclass, of its own kind
        """How it stands now."""

    @property
    def functions(self) -> FunctionTable:
        """The functions that it decodes."""

    def observe(self, observer: RequestObserver) -> None:
        """Register an observer of requests, before the start."""

    def replace_policy(self, policy: Policy) -> None:
        """Let another policy hold from the next request on."""

    def end_unauthorized(self) -> int:
        """End connections of hosts that may no longer connect; how many there were."""

    def reload_security(self) -> None:
        """Read certificates anew. Raises `ConfigError`; what cannot be used leaves its listener as it was."""

    async def __aenter__(self) -> object:
        """Start."""

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> bool | None:
        """Stop."""


class DeclaredServer(Protocol):
    """What a file declares: a `Configuration`, or that of a gateway."""

    @property
    def file(self) -> SystemFile:
        """Its sections."""

    @property
    def listeners(self) -> tuple[Listener, ...]:
        """Where it listens."""

    @property
    def access(self) -> AccessRules | None:
        """The rules that it has."""

    @property
    def audit(self) -> str | None:
        """Path of the audit log."""

    @property
    def control(self) -> str | None:
        """Where it is controlled; None for the usual place."""

    @property
    def at_once(self) -> frozenset[str]:
        """Sections that hold at once when the file is read again."""

    def serve(self, listen: Iterable[str | Listener] = (), **options: Any) -> RunningServer:  # of several types
        """What it declares, not started yet."""

    async def apply_to(self, running: Any, listen: Sequence[Listener], *, policy: Policy | None) -> list[str]:
        """Apply it to a running server, as far as possible without a restart; what changed. Raises `ModbusError`."""
