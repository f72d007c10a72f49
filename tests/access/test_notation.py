"""Units, functions and ranges as people write them."""

import pytest

from busway.access.notation import (
    merged,
    parse_files,
    parse_functions,
    parse_items,
    parse_table,
    parse_units,
    parse_whole_functions,
)
from busway.codes import Table
from busway.errors import ConfigError

HOLDING, COILS = Table.HOLDING_REGISTERS, Table.COILS


@pytest.mark.parametrize(
    ("written", "units"),
    [
        (7, {7}),
        ("7", {7}),
        ("1-5,7", {1, 2, 3, 4, 5, 7}),
        ("1…3, 0x10", {1, 2, 3, 16}),
        ([1, "4..5"], {1, 4, 5}),
        ("0-255", set(range(256))),
    ],
)
def test_units(written, units):
    assert parse_units(written) == units


@pytest.mark.parametrize("written", ["", "a", "5-1", "1-2-3", 256, -1, "1-256", True, "1,,2", ["1", None], "-5"])
def test_units_that_cannot_be(written):
    with pytest.raises(ConfigError):
        parse_units(written)


def test_files():
    assert parse_files("1-4,5,9") == ((1, 6), (9, 10))


@pytest.mark.parametrize(
    ("written", "functions"),
    [
        (16, {(16, None)}),
        ("0x10", {(16, None)}),
        ("Write Multiple Registers", {(16, None)}),
        (["write_registers", "write_coil"], {(16, None), (5, None)}),
        ("read", {(code, None) for code in (1, 2, 3, 4, 20, 24)}),
        ("write", {(code, None) for code in (5, 6, 15, 16, 21, 22, 23)}),
        ("diagnostics", {(code, None) for code in (7, 8, 11, 12, 17)}),
        ("8/1, 43/14", {(8, 1), (43, 14)}),
        ("03, 08/01, 8/0x0A", {(3, None), (8, 1), (8, 10)}),
        ("force_listen_only", {(8, 4)}),
        ("read_device_identification", {(43, 14)}),
        (100, {(100, None)}),
    ],
)
def test_functions(written, functions):
    assert parse_functions(written) == functions


@pytest.mark.parametrize("written", ["raed", 0, 128, "3/1", "8/", "8/x", "", True, None, [None]])
def test_functions_that_cannot_be(written):
    with pytest.raises((ConfigError, TypeError)):
        parse_functions(written)


def test_whole_functions_may_be_written_with_zeros_and_have_no_sub_function() -> None:
    assert parse_whole_functions("03, 0x10", "a route") == {3, 16}
    with pytest.raises(ConfigError, match=r"^a route is for whole functions, not for sub-function 8/1$"):
        parse_whole_functions("08/01", "a route")


@pytest.mark.parametrize(
    ("written", "table", "items"),
    [
        ("4x101-4x200", None, {HOLDING: ((100, 200),)}),
        ("4x101-200", None, {HOLDING: ((100, 200),)}),
        ("40101-40200", None, {HOLDING: ((100, 200),)}),
        ("holding:100-199", None, {HOLDING: ((100, 200),)}),
        ("holding:0x10-0x1F", None, {HOLDING: ((16, 32),)}),
        ("holding-registers:5", None, {HOLDING: ((5, 6),)}),
        ("holding-registers:5-6", None, {HOLDING: ((5, 7),)}),
        ("%MW10-%MW12", None, {HOLDING: ((10, 13),)}),
        ("%MW10…12", None, {HOLDING: ((10, 13),)}),
        ("100-199", HOLDING, {HOLDING: ((100, 200),)}),
        (100, HOLDING, {HOLDING: ((100, 101),)}),
        (["100-109", 110, "120"], HOLDING, {HOLDING: ((100, 111), (120, 121))}),
        ("4x1, 0x1-0x8", None, {HOLDING: ((0, 1),), COILS: ((0, 8),)}),
        ("4x65536", None, {HOLDING: ((65_535, 65_536),)}),
    ],
)
def test_items(written, table, items):
    assert parse_items(written, table) == items


@pytest.mark.parametrize(
    ("written", "table"),
    [
        (100, None),
        ("100-199", None),
        ("4x200-4x100", None),
        ("4x1-0x5", None),
        ("4x1.3", None),
        ("0x1", HOLDING),
        ("4x0", None),
        ("4x65537", None),
        ("", None),
        ("x", HOLDING),
        (True, HOLDING),
    ],
)
def test_items_that_cannot_be(written, table):
    with pytest.raises(ConfigError):
        parse_items(written, table)


def test_tables_by_name():
    assert parse_table("holding") is HOLDING
    assert parse_table("coils") is COILS
    assert parse_table(COILS) is COILS
    with pytest.raises(ConfigError, match="there is no table 'holdings_'"):
        parse_table("holdings_")


def test_ranges_that_touch_are_one():
    assert merged([(5, 7), (0, 3), (3, 4), (6, 9)]) == ((0, 4), (5, 9))


BLANKS = " \t" * 500_000
"""Of a length for which a reading in quadratic time takes hours."""


@pytest.mark.parametrize(
    "text", [f"4x1{BLANKS}-{BLANKS}4x2", f"{BLANKS}4x1-4x2{BLANKS}", f"holding{BLANKS}:0{BLANKS}..{BLANKS}1"]
)
def test_blanks_cost_no_more_than_other_characters(text: str) -> None:
    assert parse_items(text, None) == {Table.HOLDING_REGISTERS: ((0, 2),)}


@pytest.mark.parametrize("text", [f"4x1{BLANKS}4x2", "1 " * 500_000, "-" * 500_000, "1-" * 500_000, "." * 500_000])
def test_what_is_long_and_no_range_is_refused_at_once(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_items(text, None)
    with pytest.raises(ConfigError):
        parse_units(text)
    with pytest.raises(ConfigError):
        parse_files(text)
    with pytest.raises(ConfigError):
        parse_functions(text)


def test_blanks_in_numbers_of_units_cost_no_more_than_other_characters() -> None:
    assert parse_units(f"1{BLANKS}-{BLANKS}3,{BLANKS}7") == {1, 2, 3, 7}
