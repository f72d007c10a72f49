"""Evaluates the rules of a policy: which rule decides about a request, compiled once for clients with equal rights.

Knows rules and the facts of one request (`busway.access.access_request`); knows no client, no connection and no store.

1. For every kind of access to a unit (function, table or files, read or write) the rules are compiled into *zones*:
   ranges of items that together cover all addresses, each with the one rule that decides there. The generic path finds
   the zones of a request, the fast path is built from the zones that permit (`busway.access.fast_path_rights`).
2. For every item that a request touches, the first rule that fits decides; if no rule fits, the default does. The
   request is permitted if all of its items are. A range that lies in several zones is decided part by part: if 100…109
   are denied, a read of 95…104 is denied.
"""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from typing import Final, NamedTuple

from ..codes import ExceptionCode, Table
from .access_request import END, AccessRequest, Space, TouchedRange
from .notation import NumberRange, merged
from .rules import DEFAULT_RULE, Action, Limits, Policy, Rule

_MOST_ACCESSES: Final = 4096
"""Most kinds of access whose zones are kept, and most units whose rules are kept; beyond that, all are dropped."""


@dataclass(slots=True)
class Decision:
    """What a policy decided about one request: permitted or not, the rule that decided, the exception code.

    Attributes:
        allowed: whether the request may be executed.
        code: exception code of the refusal; 0 if allowed.
        rule: the rule that refused, or the first that permitted; None if the default decided.
        reason: why it is refused, in words; empty if allowed.
        rates: the rules with a rate that permit it, against which the caller counts the request; empty if refused.
        needs_current: whether it is refused only because the result of a mask write (function 22) is not known; a
            caller that knows the register's value asks again with `AccessRequest.with_current`.
    """

    allowed: bool
    code: int = 0
    rule: Rule | None = None
    reason: str = ""
    rates: tuple[Rule, ...] = ()
    needs_current: bool = False

    @property
    def rule_name(self) -> str:
        """The name of the access rule that decided; ``default`` if no rule applied."""
        return DEFAULT_RULE if self.rule is None else self.rule.name


@dataclass(frozen=True, slots=True)
class Zone:
    """An address range in which one access rule decides about one kind of request.

    Attributes:
        first, end: the range of items: from ``first`` to ``end - 1``.
        rule: the rule that decides there; None for the default.
        order: position of the rule among the rules for these clients; for the default, the number of these rules.
        action: what the rule or the default does.
        permits: whether the access is permitted there, within limits and rate of the rule.
        limits: the values that may be written to each register; None: all values, or no write of holding registers.
    """

    first: int
    end: int
    rule: Rule | None
    order: int
    action: Action
    permits: bool
    limits: Limits | None

    @property
    def rule_name(self) -> str:
        """The name of the rule that decides in this address range; ``default`` if no rule applies."""
        return DEFAULT_RULE if self.rule is None else self.rule.name

    @property
    def rate(self) -> float | None:
        """Requests per second that the rule of this address range permits; None without a limit."""
        return None if self.rule is None else self.rule.rate


class UnitAccess(NamedTuple):
    """A kind of request for which rights are compiled: the unit, the function code and whether it writes.

    Attributes:
        unit: the unit asked, 0…255.
        listed: the units under which its device is configured; empty: ``unit`` alone.
        function: the function code.
        sub_function: the sub-function of 08 and 43; None for other functions, and if it is truncated.
        space: a table, the files (`FILES`), or None for requests that touch neither.
        writes: whether it is a write.
    """

    unit: int
    listed: frozenset[int]
    function: int
    sub_function: int | None
    space: Space
    writes: bool


class Rights:
    """The rules of a policy that apply to certain clients, and the decisions about requests that follow from them.

    Args:
        rules: the rules, in their order; all of them apply to the clients.
        default: decides if no rule fits a request.

    Attributes:
        permits_all: whether every request is permitted, because there are no rules and the default allows all.
    """

    def __init__(self, rules: tuple[Rule, ...], default: Action) -> None:
        self._rules = rules
        self._default = default
        self.permits_all: bool = not rules and default.permits(True)
        self._of_units: dict[tuple[int, frozenset[int]], tuple[tuple[int, Rule], ...]] = {}
        self._zones: dict[UnitAccess, tuple[list[int], tuple[Zone, ...]]] = {}

    def zones(self, access: UnitAccess) -> tuple[Zone, ...]:
        """Return all addresses as ascending zones, each with the rule that decides there, for one kind of access."""
        return self._compiled(access)[1]

    def permitted(self, access: UnitAccess) -> tuple[Zone, ...]:
        """Return the zones where a kind of request is permitted without a rate limit, ascending.

        Written values must still be within the zone's limits.
        """
        return tuple(zone for zone in self.zones(access) if zone.permits and zone.rate is None)

    def decide(self, access_request: AccessRequest) -> Decision:
        """Decide whether the rules permit a request of these clients.

        Nothing is counted: the caller counts the request against the rates in `Decision.rates`.
        """
        rates: list[Rule] = []
        first_rule: Rule | None = None
        is_first = True
        for piece in access_request.pieces:
            for zone in self._touched(access_request, piece):
                rule = zone.rule
                if not zone.permits:
                    reason = "writing is not permitted" if zone.action.permits(False) else "it is not permitted"
                    return Decision(False, _code(rule), rule, reason)
                if is_first:
                    first_rule, is_first = rule, False
                if rule is None:
                    continue
                if rule.rate is not None and rule not in rates:
                    rates.append(rule)
                if zone.limits is not None:
                    start, end = max(zone.first, piece.first) - piece.first, min(zone.end, piece.end) - piece.first
                    reason = _beyond(zone.limits, access_request, start, end)
                    if reason:
                        return Decision(
                            False, _code(rule), rule, reason, needs_current=access_request.masks is not None
                        )
        return Decision(True, rule=first_rule, rates=tuple(rates))

    def _touched(self, access_request: AccessRequest, piece: TouchedRange) -> list[Zone]:
        """Return the zones in which the items of one range of a request lie, in the order of their rules."""
        access = UnitAccess(
            access_request.unit,
            access_request.listed,
            access_request.function,
            access_request.sub_function,
            piece.space,
            piece.writes,
        )
        firsts, zones = self._compiled(access)
        begin = bisect_right(firsts, piece.first) - 1
        end = bisect_left(firsts, piece.end)
        touched = list(zones[begin:end])
        if len(touched) > 1:
            touched.sort(key=lambda zone: zone.order)
        return touched

    def _compiled(self, access: UnitAccess) -> tuple[list[int], tuple[Zone, ...]]:
        found = self._zones.get(access)
        if found is None:
            if len(self._zones) >= _MOST_ACCESSES:
                self._zones.clear()
            zones = self._compile(access)
            found = self._zones[access] = [zone.first for zone in zones], zones
        return found

    def _compile(self, access: UnitAccess) -> tuple[Zone, ...]:
        """Split all addresses into ascending zones for one kind of access.

        In each zone the first rule that applies decides.
        """
        found: list[Zone] = []
        firsts, ends = [0], [END]  # what no rule has taken yet
        for order, rule in self._of_unit(access.unit, access.listed):
            if not rule.access.fits(access.writes) or not rule.names(access.function, access.sub_function):
                continue
            for low, high in rule.ranges(access.space):
                begin, stop = bisect_right(ends, low), bisect_left(firsts, high)
                if begin >= stop:
                    continue
                found += [
                    self._zone(access, max(firsts[at], low), min(ends[at], high), rule, order)
                    for at in range(begin, stop)
                ]
                left = [(firsts[begin], low)] if firsts[begin] < low else []
                left += [(high, ends[stop - 1])] if high < ends[stop - 1] else []
                firsts[begin:stop] = [first for first, _ in left]
                ends[begin:stop] = [end for _, end in left]
            if not firsts:
                break
        found += [
            self._zone(access, first, end, None, len(self._rules)) for first, end in zip(firsts, ends, strict=True)
        ]
        return tuple(sorted(found, key=lambda zone: zone.first))

    def _zone(self, access: UnitAccess, first: int, end: int, rule: Rule | None, order: int) -> Zone:
        action = self._default if rule is None else rule.action
        limits = None
        if rule is not None and access.writes and access.space is Table.HOLDING_REGISTERS:
            limits = rule.limits
        return Zone(first, end, rule, order, action, action.permits(access.writes), limits)

    def _of_unit(self, unit: int, listed: frozenset[int]) -> tuple[tuple[int, Rule], ...]:
        """Return the rules that apply to a unit, each with its position among the rules for these clients.

        ``listed``: the units under which the unit's device is configured; a rule for any of them applies too. The
        result is cached.
        """
        key = unit, listed
        found = self._of_units.get(key)
        if found is None:
            if len(self._of_units) >= _MOST_ACCESSES:
                self._of_units.clear()
            found = self._of_units[key] = tuple(
                (order, rule)
                for order, rule in enumerate(self._rules)
                if rule.units is None or unit in rule.units or not rule.units.isdisjoint(listed)
            )
        return found


def decision_of(policy: Policy, access_request: AccessRequest) -> Decision:
    """Decide whether a policy permits one request; `Rights` is faster for many requests of one client."""
    return Rights(policy.rules_for(access_request.subject), policy.default).decide(access_request)


def ranges_of(zones: tuple[Zone, ...]) -> tuple[NumberRange, ...]:
    """Return the address ranges of zones without their rules, adjacent ones joined."""
    return merged([(zone.first, zone.end) for zone in zones])


def _code(rule: Rule | None) -> int:
    return int(ExceptionCode.ILLEGAL_FUNCTION) if rule is None else int(rule.code)


def _beyond(limits: Limits, access_request: AccessRequest, start: int, end: int) -> str:
    """Return in words why a write to the registers ``start``…``end - 1`` breaks the value limits; empty if it does not.

    Both positions count from the first register of the written range. A write of unknown values breaks the limits. For
    a mask write of an unknown old value, all values that the masks permit must be within them.
    """
    bounds = f"{limits.low}…{limits.high}"
    if access_request.masks is not None:
        return "" if limits.permit_masks(*access_request.masks) else f"the masks may give a value outside {bounds}"
    if access_request.written is None or len(access_request.written) < end:
        return "what it would write is not known, and there are limits"
    for register in access_request.written[start:end]:
        if not limits.permit(register):
            return f"a value outside {bounds}"
    return ""
