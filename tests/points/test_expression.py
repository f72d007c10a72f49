"""Expressions: what they compute, what they refuse, and that nothing of Python is executed."""

import math

import pytest

from busway.errors import ConfigError
from busway.points.expression import parse_expression

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
def test_what_cannot_be_computed_is_no_number(text: str) -> None:
    assert math.isnan(computed(text))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is no expression"),
        ("1 +", "is no expression"),
        ("a b", "is no expression"),
        ("__import__('os')", "there is no function '__import__'"),
        ("open('x')", "there is no function 'open'"),
        ("a.b()", "cannot stand in an expression"),
        ("(lambda: 1)()", "cannot stand in an expression"),
        ("[1, 2]", "cannot stand in an expression"),
        ("a[0]", "cannot stand in an expression"),
        ("'text'", "cannot stand in an expression"),
        ("(1).real", "cannot stand in an expression"),
        ("a @ b", "cannot stand in an expression"),
        ("a << 3", "cannot stand in an expression"),
        ("a := 3", "is no expression"),
        ("x for x in a", "is no expression"),
        ("a is b", "cannot stand in an expression"),
        ("1j", "cannot stand in an expression"),
        ("min(a)", "min takes 2…16 values, not 1"),
        ("sqrt(1, 2)", "sqrt takes 1 value, not 2"),
        ("min(*a)", "min takes"),
        ("round(a, ndigits=2)", "cannot stand in an expression"),
        ("point(a)", "takes the name of a point"),
        ("f'{a}'", "cannot stand in an expression"),
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


HUGE = 10**8


@pytest.mark.parametrize(
    ("value", "digits", "rounded"),
    [
        (7, -HUGE, 0.0),
        (7, HUGE, 7.0),
        (-(2**63), -(2**63), 0.0),
        (2.345, HUGE, 2.345),
        (2.345, -HUGE, 0.0),
        (1e308, 400, 1e308),
        (5e-324, 401, 5e-324),
        (1234, -2, 1200.0),
        (2.345, 1, 2.3),
        (2.345, True, 2.3),
    ],
)
def test_digits_of_rounding_are_bounded_whatever_a_point_holds(value: float, digits: float, rounded: float) -> None:
    """A client may write any number into a point that stands for digits."""
    held = {"value": value, "digits": digits}
    assert parse_expression("round(value, digits)").bind(lambda name: lambda: held[name])(0.0) == rounded


@pytest.mark.parametrize("digits", [math.nan, math.inf, -math.inf])
def test_digits_that_are_no_number_give_no_number(digits: float) -> None:
    assert math.isnan(parse_expression("round(7, d)").bind(lambda name: lambda: digits)(0.0))


@pytest.mark.parametrize(
    "text",
    [
        "a ** a ** a ** a",
        "a ** -a",
        "*".join(["a"] * 40),
        "floor(1e308)" + " * floor(1e308)" * 35,
        "9" * 990,
        "exp(exp(exp(a)))",
        "a // 1e-300 % 3",
        "log(a, 1)",
    ],
)
@pytest.mark.parametrize("value", [0, 1, -1, 2**63, -(2**63), 1e308, -1e308, 5e-324, math.inf, -math.inf, math.nan])
def test_extreme_numbers_give_a_number_or_none_and_nothing_is_raised(text: str, value: float) -> None:
    result = parse_expression(text).bind(lambda name: lambda: value)(0.0)
    assert isinstance(result, float)


@pytest.mark.parametrize(
    "text",
    [
        "[" + "-" * 900 + "1]",
        "[a" + ".a" * 400 + "]",
        "a.b[0]" + ".a" * 400,
        "-" * 990 + "1",
        "not " * 240 + "1",
        "(" * 199,
        "f(" * 99 + ")" * 99,
    ],
)
def test_what_is_nested_deeply_is_refused_with_a_sentence(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_expression(text)


def test_whole_numbers_have_at_most_64_bits_where_they_stay_whole() -> None:
    assert parse_expression("a * 1").result({"a": 2**64 - 1}) == 2**64 - 1
    with pytest.raises(ConfigError, match="'a' has 65 bits, and whole numbers have at most 64"):
        parse_expression("a").result({"a": 2**64})
    with pytest.raises(ConfigError, match=r"has 128 bits, and whole numbers have at most 64"):
        parse_expression("a * a").result({"a": 2**64 - 1})
    assert parse_expression("a * 1.0").result({"a": 2**63}) == 2.0**63
