"""Finds gaps of a policy: routes that reach a rule's device by units or addresses that the rule does not name.

Knows routes, and asks the evaluator of rules (`busway.access.rule_evaluation`) what is permitted; opens nothing.
Rules name units and addresses as clients use them. If a second route gives the same device another unit, or its
registers other addresses, a rule for the first numbers does not hold for the second: `gateway check` warns if more is
permitted by the second route.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, permutations

from ...access.access_request import TouchedRange, touched_by
from ...access.notation import NumberRange
from ...access.rule_evaluation import Rights, UnitAccess, Zone
from ...access.rules import Action, Policy, Rule
from ...codes import Table
from ...config.files.key_lines import KeyPath
from ...pdu.functions import STANDARD
from ...pdu.message import Request
from .file_routes import PlacedRoute
from .routes import Route

RoutedUnit = tuple[PlacedRoute, int]
"""A route that leads to a device, and the unit that clients ask to use it."""
RequestedRange = tuple[type[Request], TouchedRange]
"""A function, and a range of data that it reads or writes."""


def policy_gaps(
    policy: Policy, routes: Sequence[PlacedRoute], same_device: Mapping[str, Sequence[frozenset[int]]]
) -> Iterator[tuple[KeyPath, str]]:
    """Yield the access rules that clients can evade by another route to the same device.

    Yields the path of the rule in the gateway file and a message, once for each route that evades it.

    Args:
        policy: the access rules.
        routes: the routes of the file.
        same_device: for each upstream, by name, the groups of units that are the same device.
    """
    devices = _reached_in_several_ways(routes, same_device)
    if not devices:
        return
    accesses = _accesses(policy, routes)
    of_clients: dict[object, Rights] = {}
    for index, rule in enumerate(policy.rules):
        if rule.action is Action.ALLOW and rule.rate is None and rule.limits is None:
            continue
        clients = rule.peers, rule.roles, rule.listeners
        if clients not in of_clients:
            rules = tuple(other for other in policy.rules if _is_for_clients_of(rule, other))
            of_clients[clients] = Rights(rules, policy.default)
        told: set[int] = set()
        for routed, other in chain.from_iterable(permutations(reached, 2) for reached in devices):
            if id(other[0]) not in told:
                sentence = _evaded(rule, of_clients[clients], accesses, routed, other)
                if sentence:
                    told.add(id(other[0]))
                    yield ("policy", "rule", index), sentence


def _accesses(policy: Policy, routes: Sequence[PlacedRoute]) -> list[RequestedRange]:
    """Return the accesses to test, each a function and a table that it reads or writes.

    Of several functions that all rules and routes treat alike, only the first is returned.
    """
    by_rules = [rule for rule in policy.rules if rule.functions is not None]
    found: dict[object, RequestedRange] = {}
    for kind in STANDARD:
        named = tuple(rule.names(kind.code, kind.sub_code) for rule in by_rules)
        routed = tuple(kind.code in one.route.functions for one in routes)
        for touched in touched_by(kind):
            found.setdefault((touched.space, touched.writes, named, routed), (kind, touched))
    return list(found.values())


def _reached_in_several_ways(
    routes: Sequence[PlacedRoute], same_device: Mapping[str, Sequence[frozenset[int]]]
) -> list[list[RoutedUnit]]:
    """Return the devices that clients reach by several units or address shifts, each as a list of route and unit."""
    devices: dict[tuple[str, int], list[RoutedUnit]] = {}
    for one in routes:
        if one.route.upstream:
            for unit in sorted(one.route.units):
                behind = one.route.upstream_unit(unit)
                alike = next((group for group in same_device.get(one.route.upstream, ()) if behind in group), (behind,))
                devices.setdefault((one.route.upstream, min(alike)), []).append((one, unit))
    return [reached for reached in devices.values() if len({(unit, one.route.shift) for one, unit in reached}) > 1]


def _is_for_clients_of(rule: Rule, other: Rule) -> bool:
    """Whether the access rule ``other`` surely applies to all clients to which ``rule`` applies.

    It does if each of its conditions (peers, roles, listeners) is missing, or is the same in ``rule``.
    """
    return (
        other.peers in (None, rule.peers)
        and other.roles in (None, rule.roles)
        and other.listeners in ((), rule.listeners)
    )


def _evaded(
    rule: Rule, rights: Rights, accesses: Sequence[RequestedRange], routed: RoutedUnit, other: RoutedUnit
) -> str:
    """Return a sentence on how a request by another route can do more than a rule permits; empty if it cannot.

    Args:
        rule: the rule.
        rights: evaluates the rules for the clients of that rule.
        accesses: the kinds of access to test.
        routed: the route and unit that the rule is about.
        other: another route and unit to the same device.
    """
    (near, asked), (far, unit) = routed, other
    is_named = rule.units is None or unit in rule.units
    if (rule.units is not None and asked not in rule.units) or (is_named and near.route.shift == far.route.shift):
        return ""
    for kind, touched in accesses:
        is_item = isinstance(touched.space, Table)
        if (is_named and not is_item) or not (_takes(near.route, kind) and _takes(far.route, kind)):
            continue
        shift = near.route.shift - far.route.shift if is_item else 0
        mine, others = (
            rights.zones(UnitAccess(each, frozenset(), kind.code, kind.sub_code, touched.space, touched.writes))
            for each in (asked, unit)
        )
        for zone in mine:
            taken = _taken(near.route, touched, zone.first, zone.end) if zone.rule is rule else None
            found = None if taken is None else _taken(far.route, touched, taken[0] + shift, taken[1] + shift)
            if found is not None and any(_permits_more(each, zone, found) for each in others):
                if not is_named:
                    return (
                        f"does not hold for unit {unit}, which {far.title} leads to the same device as unit {asked}: "
                        f"unit {near.route.upstream_unit(asked)} of line {near.route.upstream!r}"
                    )
                assert isinstance(touched.space, Table)
                items = f"{touched.space.label}s {found[0]}…{found[1] - 1}"
                return (
                    f"does not hold for {items} of unit {unit}: by {far.title} these are "
                    f"the same as its {found[0] - shift}…{found[1] - 1 - shift}, which it names"
                )
    return ""


def _takes(route: Route, kind: type[Request]) -> bool:
    return not route.functions or kind.code in route.functions


def _taken(route: Route, touched: TouchedRange, low: int, high: int) -> NumberRange | None:
    """Return the part of the addresses ``low`` … ``high - 1`` that a route takes: first address and end (exclusive).

    None if the route takes none of them.
    """
    if isinstance(touched.space, Table):
        low, high = max(low, 0), min(high, 0x10000)
    if route.addresses is not None:
        if route.addresses.table is not touched.space:
            return None
        low, high = max(low, route.addresses.first), min(high, route.addresses.end)
    return (low, high) if low < high else None


def _permits_more(other: Zone, zone: Zone, items: NumberRange) -> bool:
    """Whether the rule for another route permits more of some items than the rule for this route.

    True if it permits items that this route's rule refuses, or permits them with another rate or other limits. False if
    one and the same access rule decides for both routes.

    Args:
        other: zone of the rules for the other route: a range of items in which one rule decides.
        zone: zone of the rules for this route.
        items: the items of ``zone`` as the other route numbers them: first address and end.
    """
    if not other.permits or other.end <= items[0] or items[1] <= other.first or other.rule is zone.rule:
        return False
    return not zone.permits or (other.rate, other.limits) != (zone.rate, zone.limits)


__all__ = ["policy_gaps"]
