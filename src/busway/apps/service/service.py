"""A running server and the services around it: policy, audit log, metrics and control socket.

Knows components and the order in which they start and stop; knows no request. `busway.apps.service.reload` reads the
configuration again while it runs.
"""

import asyncio
from collections.abc import Callable
from contextlib import AsyncExitStack
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from ..control.addresses import OFF
from .access_in_force import AccessInForce
from .overrides import Overrides
from .reload import Reload
from .service_interfaces import DeclaredServer, RunningServer

if TYPE_CHECKING:
    from ...access.audit_log import AuditLog


class Service:
    """A server with its policy, audit log, metrics and control socket; ``async with`` starts and stops all of them.

    Args:
        read: reads and checks the configuration; called by the constructor, and again by `reload` in a thread.
        overrides: command-line options that replace parts of the configuration.

    Attributes:
        configuration: the configuration with which the service was started; a reload does not replace it.
        server: the server; set when the ``async with`` block is entered.
        metrics: URL of the metrics, set when the block is entered; empty if none are offered.

    Raises:
        ConfigError, LinkDown: a component cannot be built or opened; then nothing runs. Raised by the constructor, or
            when the ``async with`` block is entered.
    """

    server: RunningServer

    def __init__(self, read: Callable[[], DeclaredServer], overrides: Overrides | None = None) -> None:
        self._overrides = overrides or Overrides()
        self.configuration: DeclaredServer = read()
        self.metrics: str = ""
        self._access = AccessInForce(self.configuration, self._overrides)
        self._reload = Reload(read, self._overrides, self.configuration, self._access)
        self._audit: AuditLog | None = None
        self._reloading = asyncio.Lock()
        self._stack = AsyncExitStack()

    @property
    def read_only(self) -> tuple[str, ...]:
        """URLs of the listeners that are read-only because there is no policy and other hosts can reach them."""
        return self._access.read_only

    async def __aenter__(self) -> Self:
        async with self._reloading, AsyncExitStack() as stack:  # a reload that is requested meanwhile waits
            await self._start(stack)
            self._stack = stack.pop_all()
        self._reload.exclude_rules_from_gc()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    async def _start(self, stack: AsyncExitStack) -> None:
        configuration, overrides, access = self.configuration, self._overrides, self._access
        listeners = access.listeners(configuration)
        options: dict[str, Any] = {"authorize": access.allow_list}  # as `busway.serve` takes them
        policy = access.guard(listeners)
        if policy is not None:
            options["policy"] = policy
        self._audit = self._opened_audit()
        if self._audit is not None:
            stack.callback(self._audit.close)
            options["audit"] = self._audit
        options |= overrides.server_options
        self.server = server = configuration.serve(listeners, **options)
        metrics = overrides.metrics_at(configuration)
        endpoint = None
        if metrics is not None:
            from ...observe.metrics import start_metrics

            endpoint = await stack.enter_async_context(start_metrics(server, metrics))
            self.metrics = endpoint.url
        await stack.enter_async_context(server)
        if access.is_guarded:
            access.replace_policy(server, access.rules)
        at = overrides.control_at(configuration)
        if at == OFF:
            return
        from ..control.service import open_control  # here: it brings an HTTP service

        await stack.enter_async_context(
            open_control(
                server,
                at,
                name=overrides.name,
                reload=self.reload if overrides.can_reload else None,
                metrics=None if endpoint is None else endpoint.answer,
            )
        )

    async def reload(self) -> list[str]:
        """Read the configuration again, apply what can change without a restart, and return a sentence for each change.

        Reopening the audit log and reading certificates again are among the sentences. Without any sentence, the list
        is ``["nothing has changed"]``. Call this in the event loop of the server, which goes on answering meanwhile; a
        second call waits for the first.

        Raises:
            ConfigError, LinkDown: the files have an error, or a file or port that they name cannot be opened; the
                earlier configuration is in force.
        """
        async with self._reloading:
            return await self._reload.run(self.server, self._audit)

    def _opened_audit(self) -> "AuditLog | None":
        path = self._overrides.audit_at(self.configuration)
        if path is None:
            return None
        from ...access.audit_log import AuditLog

        section = self.configuration.file.audit
        options = {} if section is None else section.options()
        return AuditLog(**{**options, "path": path})
