"""Declarations of tables: what exists, what it holds, and the error of an invalid one."""

from typing import Any

import pytest

from busway.errors import ConfigError
from busway.server.table_declaration import Cells, lay_out


def pieces(declared: Any, *, bits: bool = False) -> dict[int, list[int]]:
    """First address and values of each run."""
    return {piece.first: piece.values for piece in lay_out(declared, key="coils", bits=bits).pieces}


@pytest.mark.parametrize(
    ("declared", "expected"),
    [
        (None, {}),
        (0, {}),
        ([], {}),
        ({}, {}),
        (3, {0: [0, 0, 0]}),
        ([7, 8], {0: [7, 8]}),
        (range(3), {0: [0, 1, 2]}),
        ({5: 1, 6: 2, 9: [3, 4]}, {5: [1, 2], 9: [3, 4]}),
        ({9: [3], 5: [1, 2, 3, 4]}, {5: [1, 2, 3, 4, 3]}),
        (Cells(first=10, count=2), {10: [0, 0]}),
        (Cells(first=10, values=[5, 6]), {10: [5, 6]}),
        (Cells(first=10, count=4, values=[5]), {10: [5, 0, 0, 0]}),
        (Cells(first=10, count=4, values={11: [5], 13: 6}), {10: [0, 5, 0, 6]}),
        (Cells(values={65535: 65535}), {65535: [65535]}),
    ],
)
def test_a_declaration_lays_out_its_runs(declared: Any, expected: dict[int, list[int]]) -> None:
    assert pieces(declared) == expected


def test_bits_are_given_as_states_or_as_0_and_1() -> None:
    assert pieces([True, 0, 1, False], bits=True) == {0: [1, 0, 1, 0]}


def test_read_only_ranges_are_kept_ascending_with_their_ends() -> None:
    layout = lay_out(Cells(count=100, read_only=[(50, 5), (0, 1)]), key="coils")
    assert layout.read_only == ((0, 1), (50, 55))


def test_the_declared_list_is_not_kept() -> None:
    values = [1, 2]
    layout = lay_out(values, key="coils")
    values.append(3)
    assert layout.pieces[0].values == [1, 2]


@pytest.mark.parametrize(
    ("declared", "bits", "sentence"),
    [
        (-1, False, "a number of items is 0…65536, not -1"),
        (65537, False, "a number of items is 0…65536, not 65537"),
        (True, False, "declares no items"),
        ("12", False, "declares no items"),
        (b"12", False, "declares no items"),
        (1.5, False, "declares no items"),
        ([65536], False, "address 0: a register holds 0…65535, not 65536"),
        ([0, -1], False, "address 1: a register holds 0…65535, not -1"),
        ([1.0], False, "a register holds 0…65535, not 1.0"),
        ([2], True, "a bit is True or False, not 2"),
        (["off"], True, "a bit is True or False, not 'off'"),
        ({5: "12"}, False, "address 5: '12' is no list of values"),
        ({"5": 1}, False, "an address is a whole number, not '5'"),
        ({-1: 1}, False, "addresses are 0…65535, but -1…-1 are declared"),
        ({65535: [1, 2]}, False, "addresses are 0…65535, but 65535…65536 are declared"),
        ({0: [1, 2, 3], 2: 5}, False, "address 2 is declared twice"),
        (Cells(first=65535, count=2), False, "addresses are 0…65535"),
        (Cells(first=True, count=2), False, "the first address is a whole number, not True"),
        (Cells(first=1, values={5: 1}), False, "a mapping names its own addresses"),
        (Cells(count=1, values=[1, 2]), False, "values for 0…1, but 1 items from 0 on are declared"),
        (Cells(first=5, count=2, values={4: 1}), False, "values for 4…4, but 2 items from 5 on are declared"),
        (Cells(count=5, read_only=[(4, 2)]), False, "the read-only range 4…5 holds addresses that do not exist"),
        (Cells(count=5, read_only=[(4, 0)]), False, "a count from 1"),
        (Cells(count=5, read_only=[(-1, 2)]), False, "a first address from 0"),
        (Cells(count=5, read_only=[4]), False, "a range is its first address and a count, not 4"),  # type: ignore[list-item]
    ],
)
def test_what_cannot_be_is_refused_with_its_argument_named(declared: Any, bits: bool, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        lay_out(declared, key="coils", bits=bits)
    assert sentence in str(caught.value)
    assert caught.value.key == "coils"


def test_a_file_has_fewer_addresses_than_a_table() -> None:
    with pytest.raises(ConfigError, match="addresses are 0…9999"):
        lay_out({9999: [1, 2]}, key="files[4]", size=10_000)
