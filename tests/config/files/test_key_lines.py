"""Every key of a TOML text at its line."""

import tomllib
from typing import Any

import pytest

from busway.config.files.key_lines import KeyPath, key_lines, line_of

TEXT = '''\
# a comment with = and [brackets]
title = "a # no comment" # and one

[owner."first.name"]
age.years = 3
text = """
[not.a.table]
key = 1 \\""" still
"""
literal = \'\'\'
"""
\'\'\'

[[unit]]
unit = 1
table = { first = 0, count = [1, 2], inner.deep = { x = 1 } }
many = [
    1, # one
    { a = 1 },

    [2,
     3],
]

[[unit.point]]
name = 'x=[y]'
[[unit.point]]
name = "second"
[unit.point.extra]
when = 1979-05-27T07:32:00Z

[[unit]]
[[unit.point]]
"quoted key" = true
'''


@pytest.mark.parametrize(
    ("path", "line"),
    [
        (("title",), 2),
        (("owner",), 4),
        (("owner", "first.name"), 4),
        (("owner", "first.name", "age", "years"), 5),
        (("owner", "first.name", "text"), 6),
        (("owner", "first.name", "literal"), 10),
        (("unit", 0), 14),
        (("unit", 0, "unit"), 15),
        (("unit", 0, "table", "count", 1), 16),
        (("unit", 0, "table", "inner", "deep", "x"), 16),
        (("unit", 0, "many"), 17),
        (("unit", 0, "many", 0), 18),
        (("unit", 0, "many", 1, "a"), 19),
        (("unit", 0, "many", 2), 21),
        (("unit", 0, "many", 2, 1), 22),
        (("unit", 0, "point", 0), 25),
        (("unit", 0, "point", 0, "name"), 26),
        (("unit", 0, "point", 1, "name"), 28),
        (("unit", 0, "point", 1, "extra", "when"), 30),
        (("unit", 1), 32),
        (("unit", 1, "point", 0, "quoted key"), 34),
    ],
)
def test_a_key_has_its_line(path: KeyPath, line: int) -> None:
    assert key_lines(TEXT)[path] == line


def paths_of(value: Any, path: KeyPath = ()) -> list[KeyPath]:
    """Every path in what ``tomllib`` read."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(found for key, each in inner for found in paths_of(each, (*path, key)))]


def test_every_key_that_the_reader_finds_has_a_line() -> None:
    lines = key_lines(TEXT)
    assert [path for path in paths_of(tomllib.loads(TEXT))[1:] if path not in lines] == []


def test_windows_line_ends_count_as_one() -> None:
    assert key_lines("a = 1\r\nb = 2\r\n")[("b",)] == 2


def test_a_key_that_is_missing_has_the_line_of_its_table() -> None:
    assert line_of(key_lines(TEXT), ("unit", 0, "point", 1, "address")) == 27


def test_a_key_that_is_missing_at_the_top_has_the_first_line() -> None:
    assert line_of(key_lines(TEXT), ("listen",)) == 1
