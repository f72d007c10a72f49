"""The cached read plans of a device: when they are made anew, and how good those are that are kept."""

import random

import pytest

from busway.apps.collector.cost import ReadCost, network_cost
from busway.apps.collector.learning import ReadOutcome
from busway.apps.collector.plan import PlainItem, ReadRules, plan_reads, predicted
from busway.apps.collector.plan_cache import CHECKED_EVERY, NEAR, WORTH, PlanBook
from busway.codes import Table

H = Table.HOLDING_REGISTERS
ALL = frozenset({"all"})
BRIDGED = ReadRules(bridge=True)


def scattered(seed: int, count: int = 120) -> list[PlainItem]:
    source = random.Random(seed)
    starts = sorted(source.sample(range(1200), count))
    return [PlainItem(source.choice((H, H, H, Table.COILS)), start, 1, start) for start in starts]


def read_all(book: PlanBook, truth: ReadCost, source: random.Random, noise: float) -> None:
    """Make the reads of one round as a device does whose replies take up to ``noise`` of their time longer."""
    for read in book.plan_for(ALL).reads:
        book.succeeded(read, truth.of(read.table, read.width) * (1 + noise * source.random()))


def settle(book: PlanBook, truth: ReadCost, source: random.Random, noise: float) -> None:
    book.plan_for(ALL)
    while (probe := book.next_test_read()) is not None:
        seconds = truth.of(probe.table, probe.width) * (1 + noise * source.random())
        book.answered(probe, ReadOutcome.SUCCESS, seconds)


@pytest.mark.parametrize("noise", [0.1, 0.5])
def test_replies_of_a_network_that_take_different_times_do_not_have_plans_made_again_and_again(noise: float) -> None:
    source = random.Random(1)
    book = PlanBook({"all": scattered(2)}, BRIDGED, network_cost(), fixed=False)
    truth = ReadCost(200e-6, 0.3e-6, 0.3e-6 / 16)
    settle(book, truth, source, noise)
    reads = 0
    while reads < 400 * CHECKED_EVERY:
        read_all(book, truth, source, noise)
        reads += len(book.plan_for(ALL).reads)
    assert book.made <= 20  # of 400 checks


@pytest.mark.parametrize("seed", range(40))
def test_a_plan_that_is_kept_is_nearly_as_fast_as_the_fastest_however_costs_change(seed: int) -> None:
    source = random.Random(seed)
    items = scattered(seed)
    fixed = bool(seed % 2)
    assumed = ReadCost(0.030, 2.3e-3, 2.3e-3 / 16)
    book = PlanBook({"all": items}, BRIDGED, assumed, fixed=fixed)
    base, register = 0.030, 2.3e-3
    settle(book, ReadCost(base, register, register / 16), source, 0.0)
    for _ in range(60):
        base = min(max(base * source.choice((0.5, 0.8, 0.97, 1.0, 1.03, 1.25, 2.0)), 1e-4), 1.0)
        if not fixed:
            register = min(max(register * source.choice((0.7, 0.97, 1.0, 1.03, 1.4)), 1e-5), 1e-2)
        for _ in range(source.randint(1, 12)):
            read_all(book, ReadCost(base, register, register / 16), source, 0.0)
        kept, checked = book.plan_for(ALL), book._cost
        fastest = plan_reads(items, BRIDGED, checked)
        assert predicted(kept.reads, checked) <= (1 + WORTH) * NEAR * fastest.seconds * (1 + 1e-9)


def test_a_device_that_became_much_slower_gets_another_plan() -> None:
    items = [PlainItem(H, start, 1, start) for start in range(0, 200, 20)]
    book = PlanBook({"all": items}, BRIDGED, ReadCost(0.010, 2.3e-3, 2.3e-3 / 16))
    source = random.Random(3)
    quick = ReadCost(0.010, 2.3e-3, 2.3e-3 / 16)
    settle(book, quick, source, 0.0)
    for _ in range(20):
        read_all(book, quick, source, 0.0)
    assert len(book.plan_for(ALL).reads) == 10
    for _ in range(60):
        read_all(book, quick.with_base(0.200), source, 0.0)
    assert len(book.plan_for(ALL).reads) < 3
