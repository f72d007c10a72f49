"""Learning of costs against a line with an unknown response time, and of maps against devices with holes and limits."""

import random
from collections.abc import Sequence
from dataclasses import dataclass, field

import pytest

from busway.apps.collector.cost import ReadCost, baud_cost, network_cost
from busway.apps.collector.knowledge import DeviceKnowledge, LearntHole, LearntLimit
from busway.apps.collector.learning import (
    CostLearner,
    MapLearner,
    ReadOutcome,
    outcome_of,
    probes_for,
    with_knowledge,
)
from busway.apps.collector.plan import DevicePlan, ItemRange, PlainItem, PlannedRead, ReadRules, plan_reads, predicted
from busway.codes import Table
from busway.testing.virtual_line import VirtualLine

H, C = Table.HOLDING_REGISTERS, Table.COILS
BRIDGED = ReadRules(bridge=True)


def items_at(places: Sequence[int], width: int = 1) -> list[PlainItem]:
    return [PlainItem(H, start, width, start) for start in places]


# What a read costs.


@dataclass
class PacedDevice:
    """A device on a line in virtual time; the collector has to learn its response time."""

    baud: int
    response_time: float
    jitter: float = 0.0
    lost: float = 0.0
    source: random.Random = field(default_factory=lambda: random.Random(7))

    def __post_init__(self) -> None:
        self.line = VirtualLine(2, self.baud, "even")
        self.now = 0.0
        self.silence = baud_cost(self.baud, response_time=1e-9).base - 13 * 11 / self.baud

    def read(self, width: int) -> float:
        """Seconds from the end of the silence before a request to the end of that after its reply."""
        begin = self.now
        master, slave = self.line.ports
        sent = master.write(bytes(8), begin)
        late = self.response_time + self.jitter * self.source.random()
        if self.source.random() < self.lost:
            late += 1.0  # an adapter that hung, a frame that was repeated below
        self.line.advance(sent + late)
        self.now = slave.write(bytes(5 + 2 * width), sent + self.silence / 2 + late) + self.silence / 2
        self.line.advance(self.now)
        return self.now - begin


@pytest.mark.parametrize("baud", [9600, 19_200, 115_200])
@pytest.mark.parametrize("response_time", [0.001, 0.004, 0.030, 0.150])
@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_after_fifty_reads_of_three_widths_the_plan_costs_at_most_two_percent_more_than_with_true_values(
    baud: int, response_time: float, lost: float
) -> None:
    source = random.Random(baud)
    items = items_at(sorted(source.sample(range(1500), 150)))
    device = PacedDevice(baud, response_time, jitter=response_time / 5, lost=lost)
    learner = CostLearner(baud_cost(baud))
    plan = plan_reads(items, BRIDGED, learner.cost)
    probes = probes_for(plan.reads, learner.cost)
    assert len({read.width for read in probes}) >= 3
    reads = (probes * 20)[:20] + list(plan.reads) * 30
    for read in reads[:50]:
        learner.observe(H, read.width, device.read(read.width))
    assert len(learner.widths) >= 3
    assert learner.is_settled
    true = baud_cost(baud, response_time=response_time * 1.1)  # jitter included
    chosen = plan_reads(items, BRIDGED, learner.cost)
    best = plan_reads(items, BRIDGED, true)
    assert predicted(chosen.reads, true) <= 1.02 * best.seconds


def test_the_base_is_learnt_from_a_few_reads_among_many_outliers() -> None:
    device = PacedDevice(9600, 0.050, lost=0.3)
    learner = CostLearner(baud_cost(9600))
    for width in (1, 10, 40) * 10:
        learner.observe(H, width, device.read(width))
    assert learner.cost.base == pytest.approx(baud_cost(9600, response_time=0.050).base, rel=0.01)


def test_a_device_that_gets_slower_is_noticed() -> None:
    learner = CostLearner(baud_cost(9600))
    for response_time in (0.005, 0.100):
        device = PacedDevice(9600, response_time)
        for width in (1, 10, 40) * 30:
            learner.observe(H, width, device.read(width))
        assert learner.cost.base == pytest.approx(baud_cost(9600, response_time=response_time).base, rel=0.01)


def test_behind_a_network_the_price_of_a_register_is_learnt_too() -> None:
    behind = baud_cost(9600, response_time=0.020)  # a gateway with a slow line
    learner = CostLearner(network_cost(), fixed=False)
    source = random.Random(3)
    for width in (1, 30, 100, 60) * 12:
        learner.observe(H, width, behind.of(H, width) + 0.002 * source.random())
    assert learner.cost.base == pytest.approx(behind.base, rel=0.05)
    assert learner.cost.per_register == pytest.approx(behind.per_register, rel=0.05)


def test_behind_a_network_reads_of_bits_teach_what_they_cost_and_mislead_no_other() -> None:
    behind = baud_cost(9600, response_time=0.020)
    source = random.Random(3)
    bits = [(C, 160), (C, 400), (C, 800), (C, 320)]
    for reads in (bits, [(H, 10), (H, 30), (H, 60), *bits]):
        learner = CostLearner(network_cost(), fixed=False)
        for table, width in reads * 20:
            learner.observe(table, width, behind.of(table, width) + 0.002 * source.random())
        assert learner.cost.base == pytest.approx(behind.base, rel=0.05)
        assert learner.cost.per_register == pytest.approx(behind.per_register, rel=0.05)
        assert learner.cost.per_bit == pytest.approx(behind.per_bit, rel=0.05)


def test_noise_of_a_quick_network_does_not_make_a_read_look_free() -> None:
    learner = CostLearner(network_cost(), fixed=False)
    for width, seconds in [(2, 0.0006), (36, 0.0300), (18, 0.0150)] * 4:  # a busy machine while wide reads were made
        learner.observe(H, width, seconds)
    assert learner.cost.base >= 0.0006 / 4
    assert learner.cost.of(H, 36) == pytest.approx(0.030, rel=0.05)


def test_a_single_slow_read_of_a_width_says_nothing_about_the_price_of_a_register() -> None:
    learner = CostLearner(network_cost(), fixed=False)
    for width, seconds in [(36, 0.050), (18, 0.020), *[(2, 0.001)] * 20]:
        learner.observe(H, width, seconds)
    assert learner.cost.per_register < 1e-6
    assert learner.cost.base == pytest.approx(0.001, rel=0.01)


def test_a_cost_is_not_known_before_three_widths() -> None:
    learner = CostLearner(baud_cost(9600))
    for _ in range(60):
        learner.observe(H, 10, 0.1)
    assert not learner.is_settled
    for width in (20, 30):
        learner.observe(H, width, 0.1)
    assert learner.is_settled


def test_nothing_is_invented_where_no_read_was_made() -> None:
    assumed = baud_cost(9600)
    assert CostLearner(assumed).cost == assumed


# What a device refuses.


@dataclass
class Refusing:
    """A device with holes, borders and a limit, which counts what it is asked."""

    holes: Sequence[int] = ()
    borders: Sequence[int] = ()
    limit: int = 125
    code: int = 2  # 0: it does not answer what it cannot read
    dead: bool = False
    asked: list[tuple[int, int]] = field(default_factory=list)

    def read(self, read: PlannedRead) -> tuple[ReadOutcome, int]:
        self.asked.append((read.start, read.width))
        if self.dead:
            return ReadOutcome.SILENCE, 0
        refused = (
            read.width > self.limit
            or any(read.start <= hole < read.end for hole in self.holes)
            or any(read.start < border < read.end for border in self.borders)
        )
        if not refused:
            return ReadOutcome.SUCCESS, 0
        return (ReadOutcome.REFUSED, self.code) if self.code else (ReadOutcome.SILENCE, 0)


@dataclass
class Collecting:
    """Rounds of reads of one device with what is learnt of it, without a clock."""

    device: Refusing
    items: list[PlainItem]
    learner: MapLearner
    rules: ReadRules = BRIDGED
    cost: ReadCost = field(default_factory=network_cost)
    failed: int = 0

    def plan(self) -> DevicePlan:
        return plan_reads(self.items, with_knowledge(self.rules, self.learner.knowledge), self.cost)

    def rounds(self, count: int) -> None:
        for _ in range(count):
            self.failed = 0
            for read in self.plan().reads:
                outcome, code = self.device.read(read)
                self.failed += outcome is not ReadOutcome.SUCCESS
                self.learner.observe(read, outcome, code)
            for _ in range(3):  # low priority: a few test reads between two rounds
                test_read = self.learner.next_test_read()
                if test_read is not None:
                    self.learner.answered(*self.device.read(test_read))


def collecting(device: Refusing, places: Sequence[int], width: int = 1) -> Collecting:
    return Collecting(device, items_at(places, width), MapLearner(DeviceKnowledge(), network_cost()))


@pytest.mark.parametrize("code", [2, 3])
def test_one_item_that_is_refused_is_found_and_not_asked_again(code: int) -> None:
    run = collecting(Refusing(holes=[37], code=code), range(100))
    run.rounds(20)
    assert run.learner.knowledge.holes == (LearntHole(H, 37, 38, code),)
    assert run.failed == 0
    run.device.asked.clear()
    run.rounds(50)
    assert not [place for place, width in run.device.asked if place <= 37 < place + width]
    assert [one.item.start for one in run.plan().unreadable] == [37]
    assert len(run.device.asked) == 100  # two reads a round, and no test read


def test_a_hole_costs_few_test_reads() -> None:
    run = collecting(Refusing(holes=[37]), range(100))
    run.rounds(20)
    assert run.learner.asked <= 16


def test_several_holes_are_found_one_after_the_other() -> None:
    run = collecting(Refusing(holes=[3, 40, 41, 90]), range(100))
    run.rounds(60)
    assert sorted(hole.start for hole in run.learner.knowledge.holes) == [3, 40, 41, 90]
    assert run.failed == 0


def test_a_hole_between_items_is_not_taken_for_a_limit_of_width() -> None:
    run = collecting(Refusing(holes=[25]), [*range(20), *range(30, 50)])
    run.rounds(20)
    assert run.learner.knowledge.holes == (LearntHole(H, 20, 30, 2),)
    assert run.learner.knowledge.limits == ()
    assert [(read.start, read.width) for read in run.plan().reads] == [(0, 20), (30, 20)]


def test_a_border_that_reads_must_not_cross_is_told_from_a_hole_and_from_a_limit() -> None:
    run = collecting(Refusing(borders=[30]), range(120))
    run.rounds(30)
    assert run.learner.knowledge.holes == (LearntHole(H, 30, 30, 2),)
    assert run.learner.knowledge.limits == ()
    assert [(read.start, read.width) for read in run.plan().reads] == [(0, 30), (30, 90)]


@pytest.mark.parametrize("limit", [1, 2, 10, 32, 50, 63, 64, 100, 124])
def test_the_widest_read_is_found_exactly_and_every_item_is_still_read(limit: int) -> None:
    run = collecting(Refusing(limit=limit), range(125))
    run.rounds(40)
    assert run.learner.knowledge.holes == ()
    assert run.learner.knowledge.limits == (LearntLimit(False, limit, limit + 1),)
    assert run.failed == 0
    assert not run.plan().unreadable


def test_a_limit_and_holes_together_are_both_found() -> None:
    run = collecting(Refusing(limit=40, holes=[10, 99]), range(125))
    run.rounds(80)
    assert sorted(hole.start for hole in run.learner.knowledge.holes) == [10, 99]
    limit = run.learner.knowledge.limit(False)
    assert limit is not None
    assert limit.good == 40
    assert run.failed == 0


@pytest.mark.parametrize("seed", range(30))
def test_devices_with_any_holes_and_limits_end_with_reads_that_all_succeed(seed: int) -> None:
    source = random.Random(seed)
    places = sorted(source.sample(range(300), source.randrange(2, 150)))
    holes = source.sample(range(300), source.randrange(6))
    device = Refusing(holes=holes, limit=source.choice((8, 30, 60, 125)), borders=source.sample(range(1, 300), 1))
    run = collecting(device, places)
    run.rounds(400)
    assert run.failed == 0
    # Nothing that the device gives is given up, other than what only bridging would bring.
    lost = {one.item.start for one in run.plan().unreadable}
    assert lost == set(holes) & set(places)
    run.device.asked.clear()
    run.rounds(5)
    assert len(run.device.asked) == 5 * len(run.plan().reads)


def test_silence_teaches_only_after_three_in_a_row_and_while_a_narrower_read_succeeds() -> None:
    run = collecting(Refusing(holes=[37], code=0), range(100))
    run.rounds(2)
    assert not run.learner.is_asking
    run.rounds(60)
    assert run.learner.knowledge.holes == (LearntHole(H, 37, 38, 0),)
    assert run.failed == 0


def test_a_device_that_does_not_answer_at_all_teaches_nothing() -> None:
    run = collecting(Refusing(dead=True), range(100))
    run.rounds(100)
    assert run.learner.knowledge == DeviceKnowledge()
    run.device.dead = False
    run.rounds(3)
    assert run.failed == 0


@pytest.mark.parametrize("code", [1, 4, 6, 0x0B])
def test_other_exceptions_teach_nothing(code: int) -> None:
    assert outcome_of(code) is ReadOutcome.OTHER
    run = collecting(Refusing(), range(10))
    for _ in range(50):
        run.learner.observe(run.plan().reads[0], outcome_of(code), code)
    assert not run.learner.is_asking
    assert run.learner.knowledge == DeviceKnowledge()


def test_a_test_read_that_ends_with_a_failure_ends_the_search_without_a_finding() -> None:
    run = collecting(Refusing(holes=[37]), range(100))
    run.learner.observe(run.plan().reads[0], ReadOutcome.REFUSED, 2)
    assert run.learner.is_asking
    assert not run.learner.answered(outcome_of(4), 4)
    assert not run.learner.is_asking
    assert run.learner.knowledge == DeviceKnowledge()


def test_a_refusal_that_does_not_happen_again_is_looked_into_ever_more_rarely() -> None:
    run = collecting(Refusing(), range(100))
    run.learner.observe(run.plan().reads[0], ReadOutcome.SUCCESS)
    asked = []
    for _ in range(200):
        run.learner.observe(run.plan().reads[0], ReadOutcome.REFUSED, 2)
        while (test_read := run.learner.next_test_read()) is not None:
            run.learner.answered(*run.device.read(test_read))
        asked.append(run.learner.asked)
    assert run.learner.knowledge == DeviceKnowledge()
    assert run.learner.inconclusive <= 7
    assert asked[-1] <= 25


def test_an_atomic_group_is_a_hole_as_a_whole() -> None:
    run = collecting(Refusing(holes=[11]), range(10))
    run.items += [PlainItem(H, 10 + at, 1, f"g{at}", "g") for at in range(3)]
    run.rounds(20)
    assert run.learner.knowledge.holes == (LearntHole(H, 10, 13, 2),)


def test_what_is_known_from_before_is_not_asked_again() -> None:
    known = DeviceKnowledge(holes=(LearntHole(H, 37, 38, 2),), limits=(LearntLimit(False, 50, 51),))
    run = Collecting(Refusing(holes=[37], limit=50), items_at(range(100)), MapLearner(known, network_cost()))
    run.rounds(20)
    assert run.learner.asked == 0
    assert run.failed == 0
    assert with_knowledge(BRIDGED, known).max_registers == 50
    assert with_knowledge(BRIDGED, known).forbidden == {H: [ItemRange(37, 38)]}
