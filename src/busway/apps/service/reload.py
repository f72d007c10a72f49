"""Reads a configuration again while its server runs, and applies what can change without a restart.

Knows what differs between two configurations, and what can be replaced; knows no request.

1. If a file that is read again has an error, everything stays as it was. The files are read and checked in a thread, so
   that the server answers meanwhile, and then applied in the event loop.
2. Policy and address lists are replaced at once, and connections of hosts that may no longer connect end; certificates
   hold from the next connection on; the audit log is reopened. Changes of other sections are named: they take effect at
   the next start. Sections in ``at_once`` of the configuration (`reloadable_sections`) are applied at once, too:
   `Gateway.change` does that for a gateway.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from ...access.rules import AccessRules, Rule
from ...config.certificates import tls_of, try_certificates
from ...errors import ConfigError
from .access_in_force import AccessInForce
from .gc_pauses import collecting_paused, keep_uncollected, let_go
from .overrides import Overrides
from .reloadable_sections import LISTENER_KEYS
from .service_interfaces import DeclaredServer, RunningServer

if TYPE_CHECKING:
    from ...access.audit_log import AuditLog

_MANY_RULES: Final = 10_000
"""With more rules than this, the rules are excluded from garbage collection: one run takes 10 ms for so many rules."""


class Reload:
    """Reads the configuration of a running server again, and applies what can change without a restart.

    Args:
        read: reads and checks the configuration; called in a thread.
        overrides: command-line options that replace parts of the configuration.
        started_with: the configuration with which the service was started.
        access: the access rules in force, which a reload replaces.
    """

    def __init__(
        self,
        read: Callable[[], DeclaredServer],
        overrides: Overrides,
        started_with: DeclaredServer,
        access: AccessInForce,
    ) -> None:
        self._read = read
        self._overrides = overrides
        self._started_with = started_with
        self._access = access

    async def run(self, server: RunningServer, audit: "AuditLog | None") -> list[str]:
        """Read the configuration again, apply what can change without a restart, and return a sentence for each change.

        Reopening the audit log and reading certificates again are among the sentences, and so are changed sections that
        only the next start will see. Without any sentence, the list is ``["nothing has changed"]``. Call this again
        only after it has returned.

        Args:
            server: the running server.
            audit: the server's audit log, which is opened again (for log rotation); None without one.

        Raises:
            ConfigError, LinkDown: the files have an error, or a file or port that they name cannot be opened; the
                earlier configuration is in force.
        """
        with collecting_paused():
            found: list[ReloadedConfiguration] = []  # and not the thread's result, which would live a little longer
            await asyncio.to_thread(lambda: found.append(self._read_again()))
            reloaded = found.pop()
            done = await self._apply(reloaded, server, audit)
            left_over = reloaded.rule_lists()
            del reloaded
            await asyncio.to_thread(let_go, left_over)
            self.exclude_rules_from_gc()
        return done

    def exclude_rules_from_gc(self) -> None:
        """Exclude all existing objects from garbage collection if there are more than 10,000 access rules in force.

        Each collection would visit all rules. With fewer rules, does nothing.
        """
        rules = self._access.rules
        if rules is not None and len(rules.policy.rules) > _MANY_RULES:
            keep_uncollected()

    def _read_again(self) -> "ReloadedConfiguration":
        new = self._read()
        return read_again(self._started_with, new, self._access.rules, self._overrides.rules(new))

    async def _apply(
        self, reloaded: "ReloadedConfiguration", server: RunningServer, audit: "AuditLog | None"
    ) -> list[str]:
        """Apply a reloaded configuration to the running server, and return the sentences that `run` returns."""
        new, rules, access = reloaded.configuration, reloaded.rules, self._access
        done = []
        if audit is not None:
            audit.reopen()  # first: where it cannot be opened, nothing has changed
            done.append("the audit log was opened anew")
        with_it: list[str] = []
        done += await new.apply_to(
            server,
            access.listeners(new),
            policy=access.cautious_policy(rules),
            when_applied=lambda followed: with_it.extend(
                self._replace_access(reloaded, server, is_other=bool(followed))
            ),
        )
        done += with_it
        if any(tls_of(listener) is not None for listener in new.listeners):
            done.append(_read_certificates_again(server))
        if reloaded.later:
            done.append(f"only the next start will see {', '.join(reloaded.later)}")
        return done or ["nothing has changed"]

    def _replace_access(self, reloaded: "ReloadedConfiguration", server: RunningServer, *, is_other: bool) -> list[str]:
        """Replace policy and address lists, end connections that they forbid, and return a sentence for each change.

        Called in the step in which a gateway's routes change: a request by new routes under old rules could do what
        neither configuration permits. ``is_other``: whether anything else has changed, such as listeners.
        """
        rules, access = reloaded.rules, self._access
        done = []
        if reloaded.are_other_rules:
            done.append("the policy was replaced")
        if access.is_guarded and (is_other or reloaded.are_other_rules):
            access.replace_policy(server, rules)
        if access.replace_lists(reloaded.configuration, rules):
            done.append("the address lists of listeners were replaced")
        ended = server.end_unauthorized()
        if ended:
            done.append(f"connections of hosts that may no longer connect were ended: {ended}")
        return done


def _read_certificates_again(server: RunningServer) -> str:
    try:
        server.reload_security()
    except ConfigError as error:  # not of the new file, which was tried before: of what runs until the next start
        return f"certificates stay as they were: {error}"
    return "certificates hold from the next connection on"


@dataclass(frozen=True, slots=True)
class ReloadedConfiguration:
    """A configuration that was read again, and how it differs from the running one.

    Attributes:
        configuration: the configuration that was read.
        rules: the access rules that were read; None without a policy.
        are_other_rules: whether ``rules`` differs from the access rules in force.
        later: names of changed sections that take effect only at the next start.
        before: the rules of the policy in force.
    """

    configuration: DeclaredServer
    rules: AccessRules | None
    are_other_rules: bool
    later: list[str]
    before: tuple[Rule, ...]

    def rule_lists(self) -> list[list[Any]]:
        """Return copies of all lists of access rules, old and new; `let_go` frees large ones in a thread."""
        policy = self.configuration.file.policy
        read = () if self.rules is None else self.rules.policy.rules
        return [list(self.before), list(read), [] if policy is None else list(policy.rule)]


def read_again(
    old: DeclaredServer, new: DeclaredServer, rules_in_force: AccessRules | None, rules: AccessRules | None
) -> ReloadedConfiguration:
    """Check a configuration that was read again, prepare its rules, and compare it with that of the start.

    Applies nothing. With many rules this takes long, so call it in a thread.

    Args:
        old: the configuration with which the server was started.
        new: the configuration that was read again.
        rules_in_force: the access rules until now; None without a policy.
        rules: the access rules that were read again, from the file or as the command line says; None without a policy.

    Raises:
        ConfigError: a certificate of a listener cannot be used.
    """
    for listener in new.listeners:
        try_certificates(listener)
    if rules is not None:
        rules.policy.prepare()
    before = () if rules_in_force is None else rules_in_force.policy.rules
    return ReloadedConfiguration(new, rules, rules != rules_in_force, _differences(old, new), before)


def _differences(old: DeclaredServer, new: DeclaredServer) -> list[str]:
    """Return the names of the sections that differ in two configurations and need a restart.

    The sections in ``new.at_once``, and address lists of listeners, do not count, because a reload replaces them.
    """
    found = []
    for name in type(old.file).model_fields:
        before, after = getattr(old.file, name), getattr(new.file, name)
        if name == "listener":
            before, after = ([one.model_dump(exclude=set(LISTENER_KEYS)) for one in each] for each in (before, after))
        if name not in new.at_once and before != after:
            found.append(name)
    return found
