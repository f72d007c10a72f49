"""The words for what a check accepts."""

from busway.apps.check.check import Accepts


def test_all_exception_codes_are_any_exception() -> None:
    assert str(Accepts(reply=True, exceptions=frozenset(range(256)))) == "a reply, or any exception"


def test_few_exception_codes_are_listed() -> None:
    assert str(Accepts(exceptions=frozenset({2, 3}))) == "exception 02 or 03"
