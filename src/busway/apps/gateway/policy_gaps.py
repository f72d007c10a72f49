"""Gaps of a policy: routes that reach the device of a rule under units or addresses that the rule does not name.

Knows rules and routes; opens nothing. Rules use the numbers of the listener. If a second route gives the same device
another unit, or its registers other addresses, a rule for the first numbers does not hold for the second: `gateway
check` warns of it.
"""

from collections.abc import Iterator, Sequence

from ...access.notation import Range
from ...access.rules import Action, Policy, Rule
from ...codes import Table
from ...config.files.lines import Path as Place
from .file_routes import PlacedRoute
from .routes import Route

Device = tuple[str, int]
"""Name of the upstream, and unit there."""


def policy_gaps(policy: Policy, routes: Sequence[PlacedRoute]) -> Iterator[tuple[Place, str]]:
    """The rules that some route to their device evades: the place of each in the file, and a message."""
    forwards = [one for one in routes if one.route.upstream]
    for index, rule in enumerate(policy.rules):
        if _restricts(rule):
            for sentence in (*_by_unit(rule, policy, forwards), *_by_address(rule, forwards)):
                yield ("policy", "rule", index), sentence


def _restricts(rule: Rule) -> bool:
    return rule.action is not Action.ALLOW or rule.rate is not None or rule.limits is not None


def _by_unit(rule: Rule, policy: Policy, routes: Sequence[PlacedRoute]) -> Iterator[str]:
    """Routes that reach a device of the rule under a unit that the rule does not name."""
    if rule.units is None:
        return
    known: dict[Device, int] = {}
    for one in routes:
        for unit in sorted(one.route.units & rule.units):
            known.setdefault((one.route.upstream, one.route.upstream_unit(unit)), unit)
    for one in routes:
        route = one.route
        for unit in sorted(route.units - rule.units):
            asked = known.get((route.upstream, route.upstream_unit(unit)))
            if asked is not None and _is_permitted(policy, unit) and not _has_a_rule_alike(policy, rule, unit):
                yield (
                    f"does not hold for unit {unit}, which {one.title} leads to the same device as unit {asked}: "
                    f"unit {route.upstream_unit(unit)} of line {route.upstream!r}"
                )
                break


def _is_permitted(policy: Policy, unit: int) -> bool:
    """Whether the policy permits anything at a unit."""
    return policy.default is not Action.DENY or any(
        rule.action is not Action.DENY and (rule.units is None or unit in rule.units) for rule in policy.rules
    )


def _has_a_rule_alike(policy: Policy, rule: Rule, unit: int) -> bool:
    """Whether another rule treats a unit as this rule treats its own."""
    return any(
        other is not rule
        and other.units is not None
        and unit in other.units
        and (other.action, other.rate, other.limits) == (rule.action, rule.rate, rule.limits)
        for other in policy.rules
    )


def _by_address(rule: Rule, routes: Sequence[PlacedRoute]) -> Iterator[str]:
    """Routes that reach registers of the rule under addresses that the rule does not name."""
    for table, ranges in rule.items.items():
        devices: dict[Device, set[int]] = {}  # the shifts of routes that the rule names
        for one in routes:
            for unit in one.route.units if rule.units is None else one.route.units & rule.units:
                devices.setdefault((one.route.upstream, one.route.upstream_unit(unit)), set()).add(one.route.shift)
        for one in routes:
            sentence = _other_addresses(rule, table, ranges, one, devices)
            if sentence:
                yield sentence


def _other_addresses(
    rule: Rule, table: Table, ranges: Sequence[Range], one: PlacedRoute, devices: dict[Device, set[int]]
) -> str:
    route = one.route
    for unit in sorted(route.units if rule.units is None else route.units & rule.units):
        device = (route.upstream, route.upstream_unit(unit))
        for shift in sorted(devices.get(device, set()) - {route.shift}):
            for first, end in ranges:
                moved = (first + shift - route.shift, end + shift - route.shift)
                found = _taken(route, table, moved)
                if found is not None and not any(low <= found[0] and found[1] <= high for low, high in ranges):
                    return (
                        f"does not hold for {table.label}s {found[0]}…{found[1] - 1} of unit {unit}: by {one.title} "
                        f"these are the same as its {found[0] + route.shift - shift}…"
                        f"{found[1] - 1 + route.shift - shift}, which it names"
                    )
    return ""


def _taken(route: Route, table: Table, items: Range) -> Range | None:
    """The part of a range that a route takes."""
    low, high = max(items[0], 0), min(items[1], 0x10000)
    if route.addresses is not None:
        if route.addresses.table is not table:
            return None
        low, high = max(low, route.addresses.first), min(high, route.addresses.end)
    return (low, high) if low < high else None


__all__ = ["policy_gaps"]
