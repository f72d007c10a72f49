"""Several numbers in one value by a format of ``struct``: what they take, as strictly as the types of one number."""

import math
from decimal import Decimal
from typing import Any

import pytest

from busway.errors import InvalidRequest
from busway.values import decode, encode, parse_value


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("custom:>hHl", "-1, 0x10,0b101", (-1, 16, 5)),
        ("custom:>H", "010", (10,)),
        ("custom:>f", "010", (10,)),
        ("custom:>f", "1.5", (1.5,)),
        ("custom:>fd", "inf, -Infinity", (math.inf, -math.inf)),
        ("custom:>?b", "1,-1", (True, -1)),
    ],
)
def test_numbers_are_read_as_those_of_other_types(name: str, text: str, value: tuple[Any, ...]) -> None:
    assert parse_value(text, name) == value
    assert decode(encode([value], name), name) == [value]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("custom:>f", "1e999"),
        ("custom:>d", "-1e999"),
        ("custom:>f", "1e39"),
        ("custom:>f", "1_0"),
        ("custom:>f", "١"),
        ("custom:>H", "1_0"),
        ("custom:>H", "0o17"),
        ("custom:>H", "1.0"),
        ("custom:>H", "65536"),
        ("custom:>HH", "1"),
        ("custom:>H", ""),
        ("custom:>?x", "2"),
        ("custom:>?x", "1.0"),
    ],
)
def test_a_text_that_is_no_such_number_is_refused(name: str, text: str) -> None:
    with pytest.raises(InvalidRequest, match="does not fit custom:"):
        parse_value(text, name)


@pytest.mark.parametrize("state", [True, False, 1, 0])
def test_a_question_mark_takes_a_state(state: object) -> None:
    assert decode(encode([(state,)], "custom:>?x"), "custom:>?x") == [(bool(state),)]


@pytest.mark.parametrize("value", ["x", "", 2, -1, 1.0, None, [], object()])
def test_a_question_mark_takes_nothing_else(value: object) -> None:
    with pytest.raises(InvalidRequest, match=r"does not fit custom:>\?x, .* >\?x, True or False for each \?$"):
        encode([(value,)], "custom:>?x")


@pytest.mark.parametrize(
    ("name", "value"),
    [("custom:>2H", True), ("custom:>f?x", True), ("custom:>f?x", Decimal("sNaN")), ("custom:>2H", 1.0)],
)
def test_what_is_no_number_is_refused_where_one_is_needed(name: str, value: object) -> None:
    with pytest.raises(InvalidRequest, match=r"^values\[1\] = "):
        encode([(1, 1), (value, 1)], name)
