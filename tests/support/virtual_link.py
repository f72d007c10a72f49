"""A link on a virtual clock, whose reads take what they cost: for tests of its schedule."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from busway.apps.collector.cost import ReadCost, baud_cost
from busway.apps.collector.learning import ReadOutcome
from busway.apps.collector.plan import PlainItem, ReadRules
from busway.apps.collector.plan_cache import PlanBook
from busway.apps.collector.schedule import LinkSchedule, Turn, TurnKind, TurnOutcome
from busway.codes import Table

H = Table.HOLDING_REGISTERS
FAST = baud_cost(19_200)


def book(classes: Mapping[str, int], cost: ReadCost = FAST, *, bridge: bool = False) -> PlanBook:
    """Plans of a device that has so many two-register points of each class."""
    place = 0
    items: dict[str, list[PlainItem]] = {}
    for name, number in classes.items():
        items[name] = [PlainItem(H, place + 2 * at, 2, f"{name}{at}") for at in range(number)]
        place += 2 * number + 200
    return PlanBook(items, ReadRules(bridge=bridge), cost)


@dataclass
class VirtualLink:
    """A link whose reads take exactly what they cost, and whose silences take a timeout."""

    schedule: LinkSchedule
    now: float = 0.0
    dead: set[str] = field(default_factory=set)
    is_down: bool = False
    turns: list[tuple[float, Turn]] = field(default_factory=list)
    keep: bool = True
    hooks: list[tuple[float, Callable[[], None]]] = field(default_factory=list)
    polled: dict[str, list[float]] = field(default_factory=dict)

    def run(self, until: float) -> None:
        while self.now < until:
            while self.hooks and self.hooks[0][0] <= self.now:
                self.hooks.pop(0)[1]()
            turn = self.schedule.next(self.now)
            if isinstance(turn, float):
                nearest = min([turn, until, *(when for when, _ in self.hooks)])
                assert nearest > self.now or turn > self.now
                self.now = max(nearest, self.now + 1e-9)
                continue
            began = self.now
            outcome = TurnOutcome.ANSWERED
            if turn.device in self.dead:
                outcome = TurnOutcome.SILENT
                self.now += self.schedule.timeout
            elif self.is_down:
                outcome = TurnOutcome.DOWN
                self.now += 0.001
            else:
                self.now += sum(read.seconds for read in turn.reads) or 0.005
            if turn.kind is TurnKind.TEST_READ:
                self.schedule.devices[turn.device].book.answered(
                    turn.reads[0], ReadOutcome.SUCCESS if outcome is TurnOutcome.ANSWERED else ReadOutcome.SILENCE, 0.02
                )
            if turn.kind is TurnKind.ROUND and outcome is TurnOutcome.ANSWERED and turn.round is not None:
                self.polled.setdefault(turn.device, []).append(began)
            if self.keep:
                self.turns.append((began, turn))
            self.schedule.done(turn, began, self.now, outcome)


def link_with(devices: Mapping[str, PlanBook], periods: Mapping[str, float], timeout: float = 1.0) -> VirtualLink:
    schedule = LinkSchedule(timeout)
    for name, each in devices.items():
        schedule.add(name, each, periods, 0.0)
    return VirtualLink(schedule)
