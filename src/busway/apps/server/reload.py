"""Reading a configuration again while its server runs: what it declares now, and how that differs.

Knows configurations; changes nothing that runs. `busway.apps.server.service` puts the result into force.
"""

from dataclasses import dataclass
from typing import Any

from ...access.rules import AccessRules, Rule
from ...config.certificates import try_certificates
from .interfaces import DeclaredServer

_REPLACEABLE_OF_LISTENERS = frozenset({"allow", "deny", "secure"})


@dataclass(frozen=True, slots=True)
class ReloadedConfiguration:
    """What reading the files again gave.

    Attributes:
        configuration: what they declare.
        rules: the rules on access.
        are_other_rules: whether these are not those in force.
        later: sections that have changed and hold from the next start.
        before: the rules in force.
    """

    configuration: DeclaredServer
    rules: AccessRules | None
    are_other_rules: bool
    later: list[str]
    before: tuple[Rule, ...]

    def rule_lists(self) -> list[list[Any]]:
        """What is of no use afterwards and may be large, for `let_go`."""
        policy = self.configuration.file.policy
        read = () if self.rules is None else self.rules.policy.rules
        return [list(self.before), list(read), [] if policy is None else list(policy.rule)]


def read_again(
    old: DeclaredServer, new: DeclaredServer, rules_in_force: AccessRules | None, rules: AccessRules | None
) -> ReloadedConfiguration:
    """Judge a configuration that was read again; takes long with many rules, so call it in a thread.

    Args:
        old: the configuration that the server was started with.
        new: the configuration that was read.
        rules_in_force: the rules on access until now.
        rules: those that were read.

    Raises:
        ConfigError: a certificate cannot be used.
    """
    for listener in new.listeners:
        try_certificates(listener)
    if rules is not None:
        rules.policy.prepare()
    before = () if rules_in_force is None else rules_in_force.policy.rules
    return ReloadedConfiguration(new, rules, rules != rules_in_force, _differences(old, new), before)


def _differences(old: DeclaredServer, new: DeclaredServer) -> list[str]:
    """The sections in which two configurations differ, without what holds at once."""
    found = []
    for name in type(old.file).model_fields:
        before, after = getattr(old.file, name), getattr(new.file, name)
        if name == "listener":
            before, after = (
                [one.model_dump(exclude=set(_REPLACEABLE_OF_LISTENERS)) for one in each] for each in (before, after)
            )
        if name not in new.at_once and before != after:
            found.append(name)
    return found
