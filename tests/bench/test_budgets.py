"""A run keeps to its time: budgets of the tables, and how a table divides its own among its turns."""

from pathlib import Path

import pytest
from harness.bench import LEAST_TURN, LONGEST_TURN, Bench
from tables import TABLES

BENCH = Path(__file__).parents[2] / "bench"


def bench(*, rounds: int = 5, budget: float = 60.0, asked: float | None = None) -> Bench:
    return Bench(
        quick=False,
        rounds=rounds,
        server_core=None,
        load_core=None,
        programs={},
        peers_python=None,
        uvloop=False,
        say=lambda text: None,
        budget=budget,
        asked_seconds=asked,
    )


def test_budgets_of_all_tables_stay_below_ten_minutes_and_those_of_a_quick_run_below_one() -> None:
    assert sum(entry.full for entry in TABLES.values() if not entry.alone) <= 600
    assert sum(entry.quick or 0.0 for entry in TABLES.values()) <= 60


@pytest.mark.parametrize("name", TABLES)
def test_every_table_has_its_module(name: str) -> None:
    assert BENCH.joinpath(*TABLES[name].module.split(".")).with_suffix(".py").exists()


@pytest.mark.parametrize(("turns", "apart", "overhead"), [(10, 0.0, 0.06), (80, 4.0, 0.06), (30, 10.0, 0.35)])
def test_turns_with_their_warm_up_and_overhead_stay_within_the_budget(
    turns: int, apart: float, overhead: float
) -> None:
    one = bench(budget=120.0)
    counted = one.turn(turns, apart=apart, overhead=overhead)
    each = counted + max(counted / 5, 0.1) + overhead
    assert apart + each * turns * one.rounds <= 120.0 + 1e-6


def test_turn_is_neither_too_short_to_be_measured_nor_longer_than_it_helps() -> None:
    assert bench(budget=1.0).turn(1000) == LEAST_TURN
    assert bench(budget=1000.0).turn(2) == LONGEST_TURN


def test_seconds_that_were_asked_for_go_before_the_budget() -> None:
    assert bench(asked=0.2).turn(1000) == 0.2
