"""Finds access rules that can never decide, because an earlier rule takes all requests that they apply to.

Knows rules; knows no client and no request. The first rule that applies decides (`busway.access.rule_evaluation`), so a
rule is never reached if each of its conditions is missing in one earlier rule, or is wider there.

1. The first `COMPARED` rules are compared with each other. A later rule is found if an earlier one has the same
   conditions, or takes everything of the same clients or of more: that needs a few look-ups for each rule, however many
   there are.
2. Several earlier rules that together take all requests of a rule are not found, and neither is a network that lies in
   another one.
"""

from collections.abc import Hashable, Iterator, Sequence
from itertools import product
from typing import Final

from .notation import NumberRange
from .rules import AccessKind, Rule

COMPARED: Final = 1000
"""Number of rules at the beginning of a policy that are compared pairwise: half a million comparisons, below 1 s."""


def unreached_rules(rules: Sequence[Rule]) -> Iterator[tuple[int, int]]:
    """Yield each rule that can never decide, as its position and that of an earlier rule that decides instead.

    Args:
        rules: the rules of a policy, in their order.
    """
    alike: dict[Hashable, int] = {}
    of_clients: dict[Hashable, int] = {}
    for position, rule in enumerate(rules):
        found = alike.setdefault(_conditions(rule), position)
        if found == position:
            found = next((of_clients[each] for each in _wider_clients(rule) if each in of_clients), position)
        if found == position and position < COMPARED:
            found = next((at for at in range(position) if _covers(rules[at], rule)), position)
        if found < position:
            yield position, found
        elif _is_for_everything(rule):
            of_clients[_clients(rule)] = position


def _clients(rule: Rule) -> tuple[Hashable, ...]:
    peers = None if rule.peers is None else frozenset(rule.peers)  # `Networks` of equal lengths have equal hashes
    return peers, rule.roles, frozenset(rule.listeners)


def _conditions(rule: Rule) -> Hashable:
    return _clients(rule), rule.units, rule.functions, frozenset(rule.items.items()), rule.files, rule.access


def _wider_clients(rule: Rule) -> Iterator[Hashable]:
    """Yield the clients of a rule, and all wider ones that lack some of its conditions."""
    peers, roles, listeners = _clients(rule)
    return product((None, peers), (None, roles), (frozenset(), listeners))


def _is_for_everything(rule: Rule) -> bool:
    is_for_all_items = not rule.items and not rule.files and rule.access is AccessKind.ANY
    return is_for_all_items and rule.units is None and rule.functions is None


def _covers(earlier: Rule, later: Rule) -> bool:
    """Whether a rule applies to all requests of all clients to which a later rule applies."""
    return (
        (earlier.access is AccessKind.ANY or earlier.access is later.access)
        and _holds(earlier.units, later.units)
        and _holds(earlier.roles, later.roles)
        and (earlier.peers is None or earlier.peers == later.peers)
        and _holds_listeners(earlier, later)
        and _holds_functions(earlier, later)
        and _holds_items(earlier, later)
    )


def _holds(wide: frozenset[int] | frozenset[str] | None, narrow: frozenset[int] | frozenset[str] | None) -> bool:
    return wide is None or (narrow is not None and narrow <= wide)


def _holds_listeners(earlier: Rule, later: Rule) -> bool:
    if not earlier.listeners:
        return True
    schemes = tuple(each for each in earlier.listeners if each.endswith("://"))
    return bool(later.listeners) and all(
        each in earlier.listeners or each.startswith(schemes) for each in later.listeners
    )


def _holds_functions(earlier: Rule, later: Rule) -> bool:
    if earlier.functions is None:
        return True
    functions = earlier.functions
    return later.functions is not None and all(
        each in functions or (each[0], None) in functions for each in later.functions
    )


def _holds_items(earlier: Rule, later: Rule) -> bool:
    if not earlier.items and not earlier.files:
        return True
    if not later.items and not later.files:
        return False
    return _hold(earlier.files, later.files) and all(
        _hold(earlier.items.get(table, ()), ranges) for table, ranges in later.items.items()
    )


def _hold(wide: Sequence[NumberRange], narrow: Sequence[NumberRange]) -> bool:
    """Whether ranges contain others; in both, adjacent ranges are joined."""
    return all(any(first <= low and high <= end for first, end in wide) for low, high in narrow)
