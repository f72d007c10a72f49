"""Cache of one device's read plans, one for each set of poll classes that are due together.

Pure: knows items, rules and what is learnt; knows no clock and no socket.

1. A plan is made for a set of poll classes that are due together, not for each class. Its reads also list points of
   other classes that they fetch without taking longer.
2. One plan is kept for each such set, `MOST_PLANS` plans at most.
3. A plan is made anew if, by the costs learnt since, a new plan is faster by more than `WORTH`; when the cost first
   counts as known; and whenever a hole or limit was learnt.
4. Which plan is fastest depends on one number: how many registers take as much time as the fixed part of a request (a
   bit always takes a sixteenth of a register). A plan that was found good enough at two such numbers is good enough at
   all numbers between them, since the time of the fastest plan is a concave function of the costs. Each plan keeps that
   range, and is compared with a new plan only outside it: replies over a network vary, and making a plan takes
   milliseconds.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from .cost import NETWORK_REGISTER, ReadCost
from .knowledge import DeviceKnowledge
from .learning import BITS_OF_A_REGISTER, CostLearner, MapLearner, ReadOutcome, probes_for, read_of, with_knowledge
from .plan import DevicePlan, PlannedRead, ReadItem, ReadRules, Unreadable, plan_reads, predicted

WORTH: Final = 0.05
"""How much slower an old plan must be to be replaced, as a fraction of the new plan's time."""
NEAR: Final = 1.02
"""How far costs may leave the range in which a plan was found good enough, as a factor, before it is compared again."""
CHECKED_EVERY: Final = 16
"""Number of successful reads between two checks whether new plans would be faster."""
MOST_PLANS: Final = 32
"""Most plans of a device that are kept; when there are so many, all are dropped before the next is made."""
PROBES: Final = 4
"""Number of test reads of each width that measure the cost of reads, at the beginning and again (`PROBED_AGAIN`)."""
PROBED_AGAIN: Final = 1024
"""Number of reads after which the cost is measured again by test reads, on a network: if all reads of a plan have one
width, they do not show what a register costs."""

Classes = frozenset[str]


@dataclass(slots=True)
class _KeptPlan:
    """A plan in the cache, and the costs for which it is known to be good enough (rule 4).

    Costs are given as one number: how many registers take as much time as the fixed part of a request.

    Attributes:
        plan: the plan.
        least, most: between these two numbers the plan is at most `WORTH` slower than the fastest one.
    """

    plan: DevicePlan
    least: float
    most: float

    def is_good_at(self, price: float) -> bool:
        """Whether the plan is good enough if the fixed part of a request takes as much time as ``price`` registers."""
        return self.least / NEAR <= price <= self.most * NEAR


def _price_of(cost: ReadCost) -> float:
    """Return how many registers take as much time as the fixed part of a request (``base``)."""
    return cost.base / cost.per_register


class PlanBook:
    """Cache of one device's read plans; plans are computed when first needed, and anew if costs or rules change.

    Plans follow the results of reads, which the caller reports by `succeeded`, `failed` and `answered`.

    Args:
        items: the polled points by poll class.
        rules: limits and ranges of reads that the device allows.
        assumed: the assumed cost of its reads, used until the real one is learnt.
        fixed: whether the seconds per register of ``assumed`` are certain, as on a serial line; if not, they are learnt
            too.
        knowledge: facts already known about the device; None for none.

    Attributes:
        made: number of plans computed since the creation of the object or the last `set_class`.
    """

    def __init__(
        self,
        items: Mapping[str, Sequence[ReadItem]],
        rules: ReadRules,
        assumed: ReadCost,
        *,
        fixed: bool = True,
        knowledge: DeviceKnowledge | None = None,
    ) -> None:
        known = knowledge or DeviceKnowledge()
        if known.base is not None:
            assumed = assumed.with_base(known.base)
        if known.per_register is not None and not fixed:
            assumed = ReadCost(assumed.base, known.per_register, known.per_register / BITS_OF_A_REGISTER)
        self._items = {name: list(each) for name, each in items.items()}
        self._all = _once(one for each in self._items.values() for one in each)
        self._rules = rules
        self._is_fixed = fixed
        self._cost = assumed
        self._learner = CostLearner(assumed, fixed=fixed)
        self._map = MapLearner(known, assumed)
        self._absent: frozenset[int] = frozenset()
        self._plans: dict[Classes, _KeptPlan] = {}
        self._since_check = 0
        self._is_settled = False
        self._probes: list[PlannedRead] | None = None
        self._probe: PlannedRead | None = None
        self._probed_at = 0
        self._cheapest: PlannedRead | None = None
        self.made: int = 0

    @property
    def cost(self) -> ReadCost:
        """The seconds that reads of the device take (per request, register and bit): as learnt so far, or assumed."""
        return self._learner.cost

    @property
    def classes(self) -> Classes:
        """The names of the poll classes in which the device has points."""
        return frozenset(name for name, items in self._items.items() if items)

    @property
    def knowledge(self) -> DeviceKnowledge:
        """What is known about the device, to be saved: refused ranges, largest reads and the cost of reads.

        The cost is the one learnt now if it counts as known (`CostLearner.is_settled`); else the one known before.
        """
        known = self._map.knowledge
        if not self._learner.is_settled:
            return known
        cost = self._learner.cost
        price = round(cost.per_register, 8)
        is_learnt = not self._is_fixed and price > NETWORK_REGISTER
        return replace(known, base=round(cost.base, 6), per_register=price if is_learnt else None)

    @property
    def rules(self) -> ReadRules:
        """The rules for reading the device: those configured, narrowed by the learnt holes and limits."""
        return with_knowledge(self._rules, self._map.knowledge)

    def points(self) -> list[Any]:  # the caller's kind of ReadItem
        """Return all polled points of the device, each once, including points that it does not have now."""
        return list(self._all)

    @property
    def unreadable(self) -> tuple[Unreadable, ...]:
        """The polled points that no allowed read can fetch, because of the configured rules or of learnt holes.

        Points that `set_absent` excluded are left out.
        """
        return self.plan_for(self.classes).unreadable

    def plan_for(self, classes: Classes) -> DevicePlan:
        """Return the read plan that fetches the points of some poll classes, from the cache or computed now.

        Points that `set_absent` excluded are left out; names of unknown classes are ignored.
        """
        kept = self._plans.get(classes)
        if kept is None:
            if len(self._plans) >= MOST_PLANS:
                self._plans.clear()
            price = _price_of(self._cost)
            kept = self._plans[classes] = _KeptPlan(self._make(classes), price, price)
        return kept.plan

    def set_class(self, name: str, items: Sequence[ReadItem]) -> None:
        """Replace the device's points in a poll class, and drop all plans; an empty list removes the class.

        The result of `points` stays as it is.
        """
        self._items[name] = list(items)
        self._plans.clear()
        self.made = 0

    def set_absent(self, items: Iterable[ReadItem]) -> None:
        """Exclude points that the device does not have now from all plans.

        Points that an earlier call excluded are included again, unless they are in ``items`` too.
        """
        absent = frozenset(id(one) for one in items)
        if absent != self._absent:
            self._absent = absent
            self._plans.clear()
            self._cheapest = None

    def _make(self, classes: Classes) -> DevicePlan:
        self.made += 1
        due = _once(one for name in sorted(classes) for one in self._present(self._items.get(name, ())))
        wanted = {id(one) for one in due}
        others = [one for one in self._present(self._all) if id(one) not in wanted]
        return plan_reads(due, self.rules, self._cost, others=others)

    def _present(self, items: Sequence[ReadItem]) -> Sequence[ReadItem]:
        return [one for one in items if id(one) not in self._absent] if self._absent else items

    @property
    def cheapest(self) -> PlannedRead | None:
        """The cheapest read that has succeeded since the last change of absent points, for probing the device.

        Before the first success it is a read of the narrowest point alone, or of a plan if that is not allowed; None if
        the device has no readable points.
        """
        if self._cheapest is None:
            plan = plan_reads(self._present(self._all), self.rules, self._cost)
            narrowest = min(
                (one for read in plan.reads for one in read.items if one.group is None),
                key=lambda one: one.width,
                default=None,
            )
            if narrowest is not None and not self._rules.exact:
                return read_of(narrowest.table, [narrowest], self._cost)
            return min(plan.reads, key=lambda read: read.seconds, default=None)
        return self._cheapest

    def succeeded(self, read: PlannedRead, seconds: float) -> None:
        """Learn what reads cost from a read that succeeded at its first attempt.

        Args:
            read: the read.
            seconds: from the begin of the request to the reply.
        """
        self._succeeded(read, seconds, probes=False)
        if not (self._is_fixed or self._probes) and self._learner.reads >= self._probed_at + PROBED_AGAIN:
            self._probes = None

    def _succeeded(self, read: PlannedRead, seconds: float, *, probes: bool) -> None:
        self._learner.observe(read.table, read.width, seconds, probes=probes)
        self._map.observe(read, ReadOutcome.SUCCESS)
        if self._cheapest is None or read.seconds < self._cheapest.seconds:
            self._cheapest = read
        self._since_check += 1
        if self._since_check >= CHECKED_EVERY:
            self._since_check = 0
            self._look_at_cost()

    def failed(self, read: PlannedRead, outcome: ReadOutcome, code: int = 0) -> None:
        """Learn from a failed read which ranges the device refuses.

        Args:
            read: the read.
            outcome: its result.
            code: the exception code of the reply; 0 for none.
        """
        self._map.observe(read, outcome, code)

    def _look_at_cost(self) -> None:
        """Compare cached plans with new plans for the cost learnt so far; replace those that are slower (rule 3)."""
        settled = self._learner.is_settled
        cost = self._learner.cost
        first, self._is_settled = settled and not self._is_settled, settled
        self._cost = cost
        price = _price_of(cost)
        for classes, kept in self._plans.items():
            if kept.is_good_at(price) and not first:
                continue
            better = self._make(classes)
            if first or predicted(kept.plan.reads, cost) > (1 + WORTH) * better.seconds:
                kept.plan, kept.least, kept.most = better, price, price
            else:
                kept.least, kept.most = min(kept.least, price), max(kept.most, price)

    # What is asked to learn.

    @property
    def may_ask(self) -> bool:
        """Whether `next_test_read` possibly returns a test read: about refused ranges, or about what reads cost."""
        return self._probes is None or bool(self._probes) or self._map.is_asking

    def next_test_read(self) -> PlannedRead | None:
        """Return the next test read, to be sent at low priority; None if there is none.

        Test reads find out which ranges the device refuses, and what reads of several widths cost. The caller passes
        the result to `answered`.
        """
        asked = self._map.next_test_read()
        if asked is not None:
            return asked
        if self._probes is None:
            if not self._plans:
                return None
            self._probes = probes_for(self._reads_to_probe(), self._cost) * PROBES if self._may_probe else []
            self._probed_at = self._learner.reads
        self._probe = self._probes.pop() if self._probes else None
        return self._probe

    def _reads_to_probe(self) -> Sequence[PlannedRead]:
        """Return the reads from which `probes_for` makes test reads of different widths.

        If the seconds per register are certain, as on a serial line, these are the reads of the plans. Else the reads
        are planned as if registers cost almost nothing, so that they are as wide as the rules allow: if registers are
        slow, as on a line behind a gateway, the reads of the plans can all have one width, and do not show the cost.
        """
        if self._is_fixed:
            return [read for kept in self._plans.values() for read in kept.plan.reads]
        free = ReadCost(self._cost.base, NETWORK_REGISTER, NETWORK_REGISTER / BITS_OF_A_REGISTER)
        return plan_reads(self._present(self._all), self.rules, free).reads

    @property
    def _may_probe(self) -> bool:
        return not (self._rules.exact or self._rules.one_point)

    def answered(self, read: PlannedRead, outcome: ReadOutcome, seconds: float, code: int = 0) -> bool:
        """Learn from the result of the test read that `next_test_read` returned last.

        Args:
            read: the test read.
            outcome: its result.
            seconds: from request to reply; used only if the read succeeded.
            code: the exception code; 0 for none.

        Returns:
            Whether a refused range or a largest read was learnt, so that all cached plans were dropped.
        """
        if read is self._probe:
            self._probe = None
            if outcome is ReadOutcome.SUCCESS:
                self._succeeded(read, seconds, probes=True)
            else:
                self._probes = []  # the device may refuse such reads: the plan's own will tell
            if not self._probes:
                self._learner.end_probes()
                self._probed_at = self._learner.reads
            return False
        if outcome is ReadOutcome.SUCCESS:
            self._learner.observe(read.table, read.width, seconds)
        if not self._map.is_asking:
            return False
        learnt = self._map.answered(outcome, code)
        if learnt:
            self._plans.clear()
        return learnt

    def forget(self, known: DeviceKnowledge) -> None:
        """Replace the refused ranges and largest reads of the device by those in ``known``, and drop all plans.

        The learnt cost of reads stays.
        """
        self._map = MapLearner(known, self._cost)
        self._plans.clear()


def _once(items: Iterable[ReadItem]) -> list[ReadItem]:
    """Return the items in order, each object once."""
    return list({id(one): one for one in items}.values())
