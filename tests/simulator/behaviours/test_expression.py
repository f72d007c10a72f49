"""Expressions: what they compute, what they refuse, and that nothing of Python is executed."""

import math

import pytest

from busway.errors import ConfigError
from busway.simulator.behaviours.expression import parse_expression

VALUES: dict[str, float | int | bool] = {"a": 2, "b": 3.0, "tank.level": 1.5, "voltage L1": 230, "3/a": 7}


def computed(text: str, time: float = 0.0) -> float:
    return parse_expression(text).bind(lambda name: lambda: VALUES[name])(time)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1 + 2 * a - b / 2", 3.5),
        ("a ** 3 // 3 % 2", 0.0),
        ("-a + +b", 1.0),
        ("tank.level * 2", 3.0),
        ('point("voltage L1") + point("3/a")', 237.0),
        ("min(a, b, 1) + max(a, b)", 4.0),
        ("abs(-a) + round(2.6) + round(2.345, 1) + floor(1.9)", 2 + 3 + 2.3 + 1),
        ("sqrt(9) + exp(0) + log(1) + log(8, 2)", 7.0),
        ("sin(0) + cos(pi)", -1.0),
        ("a < b <= 3", 1.0),
        ("a == 2 and not b != 3", 1.0),
        ("a > 2 or b > 3", 0.0),
        ("10 if a > b else 20 if a == 2 else 30", 20.0),
        ("True + False", 1.0),
        ("t * 2", 21.0),
    ],
)
def test_what_is_written_is_computed(text: str, value: float) -> None:
    assert computed(text, 10.5) == pytest.approx(value)


@pytest.mark.parametrize(
    "text", ["1 / (a - 2)", "sqrt(-1)", "log(0)", "exp(1e9)", "(-8) ** 0.5", "1 % 0", "10.0 ** 400"]
)
def test_what_can_not_be_computed_is_no_number(text: str) -> None:
    assert math.isnan(computed(text))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is no expression"),
        ("1 +", "is no expression"),
        ("a b", "is no expression"),
        ("__import__('os')", "there is no function '__import__'"),
        ("open('x')", "there is no function 'open'"),
        ("a.b()", "can not stand in an expression"),
        ("(lambda: 1)()", "can not stand in an expression"),
        ("[1, 2]", "can not stand in an expression"),
        ("a[0]", "can not stand in an expression"),
        ("'text'", "can not stand in an expression"),
        ("(1).real", "can not stand in an expression"),
        ("a @ b", "can not stand in an expression"),
        ("a << 3", "can not stand in an expression"),
        ("a := 3", "is no expression"),
        ("x for x in a", "is no expression"),
        ("a is b", "can not stand in an expression"),
        ("1j", "can not stand in an expression"),
        ("min(a)", "min takes 2…16 values, not 1"),
        ("sqrt(1, 2)", "sqrt takes 1 value, not 2"),
        ("min(*a)", "min takes"),
        ("round(a, ndigits=2)", "can not stand in an expression"),
        ("point(a)", "takes the name of a point"),
        ("f'{a}'", "can not stand in an expression"),
        ("-" * 100 + "1", "is nested too deeply"),
        ("(" * 300 + "1" + ")" * 300, "is no expression"),
        ("1" + " + 1" * 300, "at most 1000 characters"),
        ("a\0", "is no expression"),
    ],
)
def test_everything_else_is_refused(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_expression(text)
    assert sentence in str(caught.value)


def test_an_expression_names_the_points_that_it_needs_each_once() -> None:
    assert parse_expression('a + tank.level * point("voltage L1") + a + t + pi + point("t")').names == (
        "a",
        "tank.level",
        "voltage L1",
        "t",
    )


def test_a_result_of_whole_numbers_is_whole() -> None:
    assert parse_expression("1000 + 10 * index").result({"index": 4}) == 1040
    with pytest.raises(ConfigError, match="has no value"):
        parse_expression("1 / index").result({"index": 0})
