"""Cache of one device's read plans, one for each set of poll classes that are due together.

Pure: knows items, rules and what is learnt; knows no clock and no socket.

1. A plan is made for a set of classes, not for each class; points of other classes come with it where they are free.
2. Plans are kept by that set, `MOST_PLANS` of them.
3. A plan is made anew where what was learnt makes the predicted time fall by more than `WORTH`, once the cost counts as
   known, and whenever a hole or limit was learnt.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from .cost import NETWORK_REGISTER, ReadCost
from .knowledge import DeviceKnowledge
from .learning import BITS_OF_A_REGISTER, CostLearner, MapLearner, ReadOutcome, probes_for, read_of, with_knowledge
from .plan import DevicePlan, PlannedRead, ReadItem, ReadRules, plan_reads, predicted

WORTH: Final = 0.05
"""Part of the predicted time that a new plan has to save."""
CHECKED_EVERY: Final = 16
"""Reads between two looks at whether new plans are worth it."""
MOST_PLANS: Final = 32
"""Plans of a device that are kept. Classes have few periods, so there are few sets of them."""
PROBES: Final = 4
"""How often each width is probed at the beginning, and again."""
PROBED_AGAIN: Final = 1024
"""Reads after which a device behind a network is probed again: its plan may have one width, which tells no price."""

Classes = frozenset[str]


class PlanBook:
    """Cache of one device's read plans; plans are computed when first needed, and anew if costs or rules change.

    Args:
        items: the polled points by poll class.
        rules: limits and ranges of reads that the device allows.
        assumed: the assumed cost of its reads until it is learnt.
        fixed: whether the price of a register is known, which it is on a line.
        knowledge: facts already known about the device.

    Attributes:
        made: how many plans were made so far.
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
        self._plans: dict[Classes, DevicePlan] = {}
        self._since_check = 0
        self._is_settled = False
        self._probes: list[PlannedRead] | None = None
        self._probe: PlannedRead | None = None
        self._probed_at = 0
        self._cheapest: PlannedRead | None = None
        self.made: int = 0

    @property
    def cost(self) -> ReadCost:
        """The seconds that reads of the device take (per request, register and bit), as far as known."""
        return self._learner.cost

    @property
    def classes(self) -> Classes:
        """The names of the poll classes (points with the same period) that the device has."""
        return frozenset(name for name, items in self._items.items() if items)

    @property
    def knowledge(self) -> DeviceKnowledge:
        """Return what was learnt about the device (refused ranges, limits, cost of reads), to be saved."""
        known = self._map.knowledge
        if not self._learner.is_settled:
            return known
        cost = self._learner.cost
        price = round(cost.per_register, 8)
        is_learnt = not self._is_fixed and price > NETWORK_REGISTER
        return replace(known, base=round(cost.base, 6), per_register=price if is_learnt else None)

    @property
    def rules(self) -> ReadRules:
        """Return the rules for reading the device, tightened by what was learnt."""
        return with_knowledge(self._rules, self._map.knowledge)

    def points(self) -> list[Any]:  # the caller's kind of ReadItem
        """Return all points of the device that are polled, each once."""
        return list(self._all)

    def plan_for(self, classes: Classes) -> DevicePlan:
        """Return the read plan for the points of some poll classes."""
        plan = self._plans.get(classes)
        if plan is None:
            if len(self._plans) >= MOST_PLANS:
                self._plans.clear()
            plan = self._plans[classes] = self._make(classes)
        return plan

    def set_class(self, name: str, items: Sequence[ReadItem]) -> None:
        """Replace the device's points in a poll class; an empty list removes the class."""
        self._items[name] = list(items)
        self._plans.clear()
        self.made = 0

    def set_absent(self, items: Iterable[ReadItem]) -> None:
        """Exclude points that the device does not have at present."""
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
        """Return the cheapest read that has succeeded, or else one of the narrowest point; None without points."""
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
        """Learn what reads cost from one that succeeded at its first attempt."""
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
        """Learn what the device refuses from a failed read, with its exception code if there is one."""
        self._map.observe(read, outcome, code)

    def _look_at_cost(self) -> None:
        """Drop cached read plans if the learnt cost of reads has changed enough (rule 3)."""
        settled = self._learner.is_settled
        cost = self._learner.cost
        first, self._is_settled = settled and not self._is_settled, settled
        old = self._cost
        if not first and abs(cost.base - old.base) <= 0.02 * old.base and cost.per_register == old.per_register:
            return
        self._cost = cost
        for classes, plan in list(self._plans.items()):
            better = self._make(classes)
            if first or predicted(plan.reads, cost) > (1 + WORTH) * better.seconds:
                self._plans[classes] = better

    # What is asked to learn.

    @property
    def may_ask(self) -> bool:
        """Whether a test read, which finds out what the device refuses, may be sent now."""
        return self._probes is None or bool(self._probes) or self._map.is_asking

    def question(self) -> PlannedRead | None:
        """Return the next test read, which finds out what the device refuses, for low priority; None without one."""
        asked = self._map.question()
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
        """Return reads of different widths: those of the plans, or the widest ones where a register has no known price.

        Plans for a slow line may have reads of one width alone.
        """
        if self._is_fixed:
            return [read for plan in self._plans.values() for read in plan.reads]
        free = ReadCost(self._cost.base, NETWORK_REGISTER, NETWORK_REGISTER / BITS_OF_A_REGISTER)
        return plan_reads(self._present(self._all), self.rules, free).reads

    @property
    def _may_probe(self) -> bool:
        return not (self._rules.exact or self._rules.one_point)

    def answered(self, read: PlannedRead, outcome: ReadOutcome, seconds: float, code: int = 0) -> bool:
        """Learn from the result of a test read. Returns whether refused ranges or limits were learnt."""
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
        """Replace what was learnt about the device, after a user had some of it forgotten or pinned."""
        self._map = MapLearner(known, self._cost)
        self._plans.clear()


def _once(items: Iterable[ReadItem]) -> list[ReadItem]:
    """Return the items without duplicate objects, in order."""
    return list({id(one): one for one in items}.values())
