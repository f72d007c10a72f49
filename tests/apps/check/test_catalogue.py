"""The checks as data: enough of them, each of a clause that the documentation has, none stronger than its clause."""

import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
from checked_device import target_of

from busway.apps.check.catalogue import checks_for
from busway.apps.check.check import Ask, Level, Strength, Target
from busway.apps.check.clauses import CLAUSES
from busway.errors import ConfigError

DATA = Path(__file__).resolve().parents[3] / "docs" / "conformance.toml"
WORDS = {one["id"]: one.get("word", "must") for one in tomllib.loads(DATA.read_text(encoding="utf-8"))["clause"]}
FRAMINGS = ["mbap", "rtu", "ascii"]


@pytest.mark.parametrize("framing", FRAMINGS)
def test_there_are_many_checks_of_each_framing_and_each_has_a_name_of_its_own(framing: str) -> None:
    checks = checks_for(target_of(framing), Level.DISRUPTIVE)
    assert len(checks) >= 120
    assert len({one.id for one in checks}) == len(checks)


@pytest.mark.parametrize("framing", FRAMINGS)
def test_clauses_are_those_of_the_documentation_and_a_must_is_one_there_too(framing: str) -> None:
    for one in checks_for(target_of(framing), Level.DISRUPTIVE):
        assert one.clause in CLAUSES
        # A function that a device may have must be right where it has it.
        if one.word is Strength.MUST and one.function is None:
            assert WORDS[one.clause] == "must", one.id


def test_every_clause_is_one_of_the_documentation_and_has_a_check() -> None:
    targets = [*map(target_of, FRAMINGS), replace(target_of("mbap"), is_secure=True)]
    used = {one.clause for target in targets for one in checks_for(target, Level.DISRUPTIVE)}
    assert set(CLAUSES) == used | {"A4"}
    assert set(CLAUSES) <= set(WORDS)


@pytest.mark.parametrize("framing", FRAMINGS)
def test_checks_that_only_read_send_nothing_else(framing: str) -> None:
    for one in checks_for(target_of(framing), Level.READ):
        assert {pdu[0] for pdu in one.requests} <= {1, 2, 3, 4, 7, 11, 12, 17, 20, 24, 43}, one.id


@pytest.mark.parametrize("framing", FRAMINGS)
def test_nothing_is_written_below_the_level_for_it(framing: str) -> None:
    assert not any(one.writes for one in checks_for(target_of(framing), Level.DIAG))


@pytest.mark.parametrize("framing", FRAMINGS)
def test_what_is_written_at_the_level_write_stands_in_the_scratch(framing: str) -> None:
    for one in checks_for(target_of(framing), Level.WRITE):
        for pdu in one.requests:
            if pdu[0] in (5, 6, 15, 16, 22):
                assert 100 <= int.from_bytes(pdu[1:3], "big") < 108, one.id
                size = int.from_bytes(pdu[3:5], "big") if pdu[0] in (15, 16) else 1
                assert 100 + size <= 108, one.id


def with_scratch(count: int) -> Target:
    """The smallest scratch, or one of another size."""
    target = target_of("mbap")
    assert target.registers is not None
    assert target.coils is not None
    return replace(target, registers=replace(target.registers, count=count), coils=replace(target.coils, count=count))


@pytest.mark.parametrize("count", [2, 8, 15, 16])
def test_a_wrong_write_stays_in_the_scratch_also_where_a_device_goes_by_its_byte_count_or_length(count: int) -> None:
    for one in checks_for(with_scratch(count), Level.WRITE):
        for pdu in (step.pdu for step in one.steps if isinstance(step, Ask) and not step.accepts.reply):
            if pdu[0] in (15, 16):
                items, size = (8, 1) if pdu[0] == 15 else (1, 2)
                written = int.from_bytes(pdu[3:5], "big")
                reach = [-(-length // size) * items for length in (pdu[5], len(pdu) - 6)]
                by_bytes = [each for each in reach if each > -(-written // items) * items]  # not the rest of a byte
                assert max(written, *by_bytes, 0) <= count, one.id


def test_a_byte_count_of_16_coils_is_sent_at_the_level_write_where_there_are_as_many() -> None:
    levels = {
        count: next(
            one.level for one in checks_for(with_scratch(count), Level.DISRUPTIVE) if one.id == "fc15-byte-count-over"
        )
        for count in (15, 16)
    }
    assert levels == {15: Level.DISRUPTIVE, 16: Level.WRITE}


def test_checks_run_from_safe_to_risky_behind_the_basic_ones() -> None:
    checks = checks_for(target_of("mbap"), Level.DISRUPTIVE)
    order = [-1 if one.facet is not None else one.level for one in checks]
    assert order == sorted(order)


def test_only_some_are_chosen_by_clause_or_name_and_the_basic_ones_are_always_there() -> None:
    checks = checks_for(target_of("mbap"), Level.DIAG, ["T28", "fc03-cut"])
    chosen = [one for one in checks if one.facet is None]
    assert {one.clause for one in chosen} == {"T28", "A7"}
    assert len([one for one in checks if one.facet is not None]) == 8


def test_a_name_that_nothing_has_is_refused() -> None:
    with pytest.raises(ConfigError, match="A99"):
        checks_for(target_of("mbap"), Level.DIAG, ["A99"])
