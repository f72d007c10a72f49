"""What the cost of reads is learnt from, and the plans for each set of poll classes."""

import random

import pytest

from busway.apps.collector.cost import ReadCost, baud_cost, network_cost
from busway.apps.collector.learning import ReadOutcome
from busway.apps.collector.plan import PlainItem, PlannedRead, ReadRules, plan_reads, predicted
from busway.apps.collector.plan_cache import CHECKED_EVERY, MOST_PLANS, PROBED_AGAIN, WORTH, PlanBook
from busway.codes import Table

H = Table.HOLDING_REGISTERS
FAST, BOTH = frozenset({"fast"}), frozenset({"fast", "slow"})
BRIDGED = ReadRules(bridge=True)


def items(places: list[int]) -> list[PlainItem]:
    return [PlainItem(H, start, 1, start) for start in places]


def book_of(places: list[int], assumed: ReadCost) -> PlanBook:
    return PlanBook({"fast": items(places)}, BRIDGED, assumed)


def answer(book: PlanBook, true: ReadCost, rounds: int) -> None:
    """Let a device answer its reads and questions, each in exactly the time that it takes."""
    book.plan_for(FAST)
    while (question := book.next_test_read()) is not None:
        book.answered(question, ReadOutcome.SUCCESS, true.of(H, question.width))
    for _ in range(rounds):
        for read in book.plan_for(FAST).reads:
            book.succeeded(read, true.of(H, read.width))


def test_a_plan_is_made_once_for_each_set_of_classes() -> None:
    book = PlanBook({"fast": items([0, 4]), "slow": items([2, 300])}, BRIDGED, baud_cost(9600))
    fast, both = book.plan_for(FAST), book.plan_for(BOTH)
    assert [(read.start, read.width) for read in fast.reads] == [(0, 5)]
    assert [item.start for item in fast.reads[0].items] == [0, 2, 4]  # the slow one between comes for nothing
    assert [(read.start, read.width) for read in both.reads] == [(0, 5), (300, 1)]
    for _ in range(100):
        assert book.plan_for(FAST) is fast
        assert book.plan_for(BOTH) is both
    assert book.made == 2


def test_no_more_plans_are_kept_than_the_limit() -> None:
    names = [f"c{number}" for number in range(6)]
    book = PlanBook({name: items([place]) for place, name in enumerate(names)}, BRIDGED, baud_cost(9600))
    for number in range(1, 64):
        book.plan_for(frozenset(name for place, name in enumerate(names) if number >> place & 1))
        assert len(book._plans) <= MOST_PLANS


def test_a_device_that_is_slower_than_assumed_gets_a_plan_with_fewer_reads() -> None:
    places = [place * 25 for place in range(20)]
    assumed, true = baud_cost(9600), baud_cost(9600, response_time=0.150)
    book = book_of(places, assumed)
    before = book.plan_for(FAST)
    assert len(before.reads) == 20
    answer(book, true, 3)
    after = book.plan_for(FAST)
    best = plan_reads(items(places), BRIDGED, true)
    assert len(after.reads) == len(best.reads) < 20
    assert predicted(after.reads, true) < (1 - WORTH) * predicted(before.reads, true)


@pytest.mark.parametrize("seed", range(20))
def test_once_the_cost_is_known_no_plan_is_dearer_than_the_best_by_more_than_it_has_to_save(seed: int) -> None:
    """The first plan that is made of what was learnt is the best to 2 %; later ones are kept until 5 % can be saved."""
    chance = random.Random(seed)
    places = sorted(chance.sample(range(900), 90))
    book = book_of(places, baud_cost(9600))
    true = baud_cost(9600, response_time=chance.choice((0.001, 0.030, 0.150)))
    answer(book, true, 6)
    best = plan_reads(items(places), BRIDGED, true)
    assert predicted(book.plan_for(FAST).reads, true) <= 1.02 * best.seconds
    for _ in range(4):  # it gets slower and faster while it is polled
        true = baud_cost(9600, response_time=chance.uniform(0.001, 0.2))
        answer(book, true, 40)
        assert book.cost.base == pytest.approx(true.base, rel=0.05)
        best = plan_reads(items(places), BRIDGED, true)
        assert predicted(book.plan_for(FAST).reads, true) <= (1 + WORTH) * best.seconds


def test_a_plan_stays_where_another_would_save_less_than_it_has_to() -> None:
    # One gap that is just worth reading, and much that is read anyway.
    places = [0, 13, *range(100, 200), *range(400, 430)]
    book = book_of(places, baud_cost(9600, response_time=0.0001))
    answer(book, baud_cost(9600, response_time=0.0001), 2 * CHECKED_EVERY)
    settled = book.plan_for(FAST)
    slower = baud_cost(9600, response_time=0.008)
    other = plan_reads(items(places), BRIDGED, slower)
    assert len(other.reads) < len(settled.reads)
    assert predicted(settled.reads, slower) < (1 + WORTH) * other.seconds
    answer(book, slower, 20 * CHECKED_EVERY)
    assert book.cost.base == pytest.approx(slower.base, rel=0.02)
    assert book.plan_for(FAST) is settled


@pytest.mark.parametrize("clusters", [(0, 50), (0, 30, 100), (0, 200)])
@pytest.mark.parametrize("response_time", [0.005, 0.020, 0.100])
def test_what_a_register_costs_behind_a_network_is_not_forgotten_where_all_reads_have_one_width(
    clusters: tuple[int, ...], response_time: float
) -> None:
    """A line behind a gateway: after 64 reads of one width the price of a register was that of a network again."""
    chance = random.Random(1)
    places = [start + place for start in clusters for place in range(10)]
    true = baud_cost(9600, response_time=response_time)
    best = plan_reads(items(places), BRIDGED, true)
    book = PlanBook({"fast": items(places)}, BRIDGED, network_cost(), fixed=False)
    for number in range(1000):
        question = book.next_test_read()
        if question is not None:
            took = true.of(H, question.width) + 0.002 * chance.random()
            book.answered(question, ReadOutcome.SUCCESS, took)
        plan = book.plan_for(FAST)
        if number > 50:
            assert predicted(plan.reads, true) <= 1.02 * best.seconds, number
        for read in plan.reads:
            book.succeeded(read, true.of(H, read.width) + 0.002 * chance.random())
    again = PlanBook({"fast": items(places)}, BRIDGED, network_cost(), fixed=False, knowledge=book.knowledge)
    assert predicted(again.plan_for(FAST).reads, true) <= 1.02 * best.seconds, "over a restart"


@pytest.mark.parametrize("seed", range(30))
def test_behind_a_network_no_plan_is_dearer_than_the_best_by_more_than_it_has_to_save(seed: int) -> None:
    """Any map in several tables, any line behind the gateway, noise, and one reply of ten that is a second late.

    2 % are what noise may do to the cost that was learnt, 5 % what another plan has to save.
    """
    chance = random.Random(seed)
    true = baud_cost(
        chance.choice((1200, 9600, 19_200, 115_200)), response_time=chance.choice((0.001, 0.005, 0.02, 0.1))
    )
    found: list[PlainItem] = []
    for table in chance.sample([H, Table.INPUT_REGISTERS, Table.COILS], chance.choice((1, 2, 3))):
        size = chance.choice((100, 400, 2000))
        found += [PlainItem(table, at, 1, (table, at)) for at in chance.sample(range(size), chance.randrange(2, 60))]
    jitter, lost = chance.choice((0.0, 0.001, 0.003)), chance.choice((0.0, 0.1))

    def took(read: PlannedRead) -> float:
        return true.of(read.table, read.width) + jitter * chance.random() + (chance.random() < lost)

    book = PlanBook({"fast": found}, BRIDGED, network_cost(), fixed=False)
    for _ in range(200):
        for read in book.plan_for(FAST).reads:
            book.succeeded(read, took(read))
        question = book.next_test_read()
        if question is not None:
            book.answered(question, ReadOutcome.SUCCESS, took(question))
    best = plan_reads(found, BRIDGED, true)
    assert predicted(book.plan_for(FAST).reads, true) <= 1.02 * (1 + WORTH) * best.seconds


def test_two_values_far_apart_tell_what_a_register_costs_too() -> None:
    true = baud_cost(9600, response_time=0.005)
    book = PlanBook({"fast": items([0, 40])}, BRIDGED, network_cost(), fixed=False)
    assert len(book.plan_for(FAST).reads) == 1
    answer(book, true, 100)
    assert book.cost.per_register == pytest.approx(true.per_register, rel=0.01)
    assert len(book.plan_for(FAST).reads) == 2


def test_a_price_that_no_read_of_the_plan_can_tell_is_asked_for_again() -> None:
    places = [0, 40, 80, 120]
    slow, quick = baud_cost(9600, response_time=0.005), baud_cost(115_200, response_time=0.005)
    book = PlanBook({"fast": items(places)}, BRIDGED, network_cost(), fixed=False)
    answer(book, slow, 100)
    assert len(book.plan_for(FAST).reads) == 4
    for _ in range(PROBED_AGAIN):  # the line is another one now
        answer(book, quick, 1)
    assert book.cost.per_register == pytest.approx(quick.per_register, rel=0.01)
    best = plan_reads(items(places), BRIDGED, quick)
    assert predicted(book.plan_for(FAST).reads, quick) <= (1 + WORTH) * best.seconds


def test_of_a_network_only_what_reads_cost_is_kept() -> None:
    book = PlanBook({"fast": items([0, 50, 51, 90, 91, 92])}, ReadRules(), network_cost(), fixed=False)
    answer(book, network_cost(0.003), 40)
    assert book.knowledge.base == pytest.approx(0.003, rel=0.01)
    assert book.knowledge.per_register is None


def test_a_hole_that_was_learnt_makes_all_plans_anew() -> None:
    book = PlanBook({"fast": items(list(range(20))), "slow": items([30])}, BRIDGED, baud_cost(9600))
    plans = {classes: book.plan_for(classes) for classes in (FAST, BOTH)}
    for _ in range(50):
        book.failed(book.plan_for(FAST).reads[0], ReadOutcome.REFUSED, 2)
        while (question := book.next_test_read()) is not None:
            refused = question.start <= 7 < question.end
            outcome = ReadOutcome.REFUSED if refused else ReadOutcome.SUCCESS
            book.answered(question, outcome, 0.05, 2 if refused else 0)
        if book.knowledge.holes:
            break
    assert [(hole.start, hole.end) for hole in book.knowledge.holes] == [(7, 8)]
    for classes, before in plans.items():
        assert book.plan_for(classes) is not before
        assert all(not each.start <= 7 < each.end for each in book.plan_for(classes).reads)
