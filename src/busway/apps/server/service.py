"""A server of a configuration and what stands around it while it runs: policy, audit log, metrics, control socket.

Knows components and the order in which they start and stop; knows no request. What it was told can be read again
while it runs, without a connection being lost.

1. What is wrong with a file that is read again changes nothing: everything stays as it was. It is read and judged in a
   thread, and put into force in the event loop, in one step: what runs answers meanwhile.
2. Policy and address lists are replaced at once, and connections of hosts that may no longer connect end; certificates
   hold from the next connection on; the audit log is opened anew. What else differs is named: it holds from the next
   start.
"""

import asyncio
import logging
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from ...access.addresses import AddressList
from ...access.rules import AccessRules, Policy
from ...config.certificates import tls_of
from ...config.gc_pauses import collecting_paused, keep_uncollected, let_go
from ...config.reloadable_access import NETWORK_SCHEMES, ReloadableAllowList, reaches_network, read_only_for
from ...errors import ConfigError
from ...server.listener import Listener
from .interfaces import DeclaredServer, RunningServer
from .reload import ReloadedConfiguration, read_again

if TYPE_CHECKING:
    from ...access.audit_log import AuditLog

_log = logging.getLogger("busway.service")

_MANY_RULES: Final = 10_000
"""Beyond so many, one round of the garbage collector would be felt: 10 ms for the objects of these."""


def declared_rules(configuration: DeclaredServer) -> AccessRules | None:
    """The access rules of the configuration itself."""
    return configuration.access


@dataclass(frozen=True, slots=True)
class Overrides:
    """Command-line overrides of the configuration.

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


class Service:
    """A running server with all around it; an asynchronous context manager that starts and stops.

    Args:
        read: gives the configuration; called again by `reload`.
        overrides: command-line overrides of it.

    Attributes:
        configuration: the one that it was started with.
        server: the server, after the start.
        read_only: URLs of the listeners that are read-only because there is no policy.
        metrics: where the metrics are scraped; empty without any.

    Raises:
        ConfigError, LinkDown: something cannot be, or cannot be had; then nothing runs.
    """

    server: RunningServer

    def __init__(self, read: Callable[[], DeclaredServer], overrides: Overrides | None = None) -> None:
        self._read = read
        self._overrides = overrides or Overrides()
        self.configuration: DeclaredServer = read()
        self.read_only: tuple[str, ...] = ()
        self.metrics: str = ""
        self._rules = self._overrides.rules(self.configuration)
        self._allow_list = ReloadableAllowList()
        self._allow_lists: dict[str, ReloadableAllowList] = {}
        self._audit: AuditLog | None = None
        self._is_guarded = False
        self._reloading = asyncio.Lock()
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        async with self._reloading, AsyncExitStack() as stack:  # what is asked meanwhile waits
            await self._start(stack)
            self._stack = stack.pop_all()
        self._spare_collector()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    async def _start(self, stack: AsyncExitStack) -> None:
        from ..control.service import OFF, open_control

        configuration, overrides = self.configuration, self._overrides
        listeners = self._listeners(configuration)
        self._allow_list.lists = self._lists(self._rules)
        options: dict[str, Any] = {"authorize": self._allow_list}  # as `busway.serve` takes them
        self._is_guarded = (
            self._rules is not None
            or overrides.can_reload
            or any(reaches_network(str(one.endpoint)) for one in listeners)
        )
        if self._is_guarded:
            options["policy"] = self._policy(self._rules, NETWORK_SCHEMES)
        self._audit = self._opened_audit()
        if self._audit is not None:
            stack.callback(self._audit.close)
            options["audit"] = self._audit
        if overrides.standard_port is not None:
            options["standard_port"] = overrides.standard_port
        self.server = server = configuration.serve(listeners, **options)
        metrics = overrides.metrics or (configuration.file.metrics.listen if configuration.file.metrics else None)
        endpoint = None
        if metrics is not None:
            from ...observe.metrics import start_metrics

            endpoint = await stack.enter_async_context(start_metrics(server, metrics))
            self.metrics = endpoint.url
        await stack.enter_async_context(server)
        if self._is_guarded:
            self._replace_policy()
        at = overrides.control or (configuration.control if configuration.file.control.enabled else OFF)
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
        """Read again what can change while it runs: what was done, a sentence each.

        Raises:
            ConfigError, LinkDown: something is wrong with what was read, or cannot be had; nothing has changed.
        """
        async with self._reloading:
            with collecting_paused():
                found: list[ReloadedConfiguration] = []  # and not the thread's result, which would live a little longer
                await asyncio.to_thread(lambda: found.append(self._read_again()))
                reading = found.pop()
                done = await self._follow(reading)
                left_over = reading.rule_lists()
                del reading
                await asyncio.to_thread(let_go, left_over)
                self._spare_collector()
        return done

    def _spare_collector(self) -> None:
        """Keep the garbage collector from looking at many rules again and again."""
        if self._rules is not None and len(self._rules.policy.rules) > _MANY_RULES:
            keep_uncollected()

    def _read_again(self) -> ReloadedConfiguration:
        new = self._read()
        return read_again(self.configuration, new, self._rules, self._overrides.rules(new))

    async def _follow(self, reading: ReloadedConfiguration) -> list[str]:
        """Let what runs follow what was read; what was done, a sentence each."""
        new, rules = reading.configuration, reading.rules
        cautious = self._policy(rules, NETWORK_SCHEMES) if self._is_guarded else None
        followed = await new.apply_to(self.server, self._listeners(new), policy=cautious)
        done = []
        if self._audit is not None:
            self._audit.reopen()
            done.append("the audit log was opened anew")
        done += followed
        if reading.are_other_rules:
            done.append("the policy was replaced")
        if self._is_guarded and (followed or reading.are_other_rules):
            self._rules = rules
            self._replace_policy()
        self._allow_list.lists = self._lists(rules)
        if self._replace_lists(new):
            done.append("the address lists of listeners were replaced")
        ended = self.server.end_unauthorized()
        if ended:
            done.append(f"connections of hosts that may no longer connect were ended: {ended}")
        if any(tls_of(listener) is not None for listener in new.listeners):
            done.append(self._read_certificates_again())
        if reading.later:
            done.append(f"only the next start will see {', '.join(reading.later)}")
        return done or ["nothing has changed"]

    def _read_certificates_again(self) -> str:
        try:
            self.server.reload_security()
        except ConfigError as error:  # not of the new file, which was tried before: of what runs until the next start
            return f"certificates stay as they were: {error}"
        return "certificates hold from the next connection on"

    def _replace_policy(self) -> None:
        """Let the policy hold, now that it is known which listeners the network reaches."""
        exposed = [url for url in self.server.endpoints if reaches_network(url)]
        self.read_only = () if self._rules is not None or self._overrides.allow_writes else tuple(exposed)
        self.server.replace_policy(self._policy(self._rules, exposed))

    def _opened_audit(self) -> "AuditLog | None":
        path = self._overrides.audit or self.configuration.audit
        if path is None:
            return None
        from ...access.audit_log import AuditLog

        section = self.configuration.file.audit
        if section is None:
            return AuditLog(path)
        return AuditLog(
            path,
            interval=section.interval,
            on_failure=section.on_failure,
            repeat_interval=section.repeat_interval,
        )

    def _policy(self, rules: AccessRules | None, exposed: Sequence[str]) -> Policy:
        """The policy that was written, or else the one that makes exposed listeners read-only."""
        if rules is not None:
            return rules.policy
        return read_only_for(() if self._overrides.allow_writes else exposed)

    def _lists(self, rules: AccessRules | None) -> tuple[AddressList, ...]:
        own = () if self._overrides.addresses is None else (self._overrides.addresses,)
        return own if rules is None else (*own, rules.addresses)

    def _listeners(self, configuration: DeclaredServer) -> list[Listener]:
        """The listeners, each asking lists that can be replaced."""
        if self._overrides.listen:
            return [Listener(url) for url in self._overrides.listen]
        found = []
        for one in configuration.listeners:
            if isinstance(one.access, AddressList):
                # The same one for ever: what was started with it is not another for having other lists.
                allow_list = self._allow_lists.setdefault(str(one.endpoint), ReloadableAllowList((one.access,)))
                one = replace(one, access=allow_list)
            found.append(one)
        return found

    def _replace_lists(self, new: DeclaredServer) -> bool:
        changed = False
        for one in new.listeners:
            allow_list = self._allow_lists.get(str(one.endpoint))
            if allow_list is not None and isinstance(one.access, AddressList) and allow_list.lists != (one.access,):
                allow_list.lists = (one.access,)
                changed = True
        return changed
