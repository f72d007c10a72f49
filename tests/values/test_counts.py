"""Numbers with their nouns."""

from typing import Any

import pytest

from busway.values.counts import counted


@pytest.mark.parametrize(
    ("count", "noun", "text"),
    [(0, "coil", "0 coils"), (1, "coil", "1 coil"), (2, "holding register", "2 holding registers"),
     (1, "retry", "1 retry"), (2, "retry", "2 retries")],
)  # fmt: skip
def test_a_number_is_said_with_its_noun(count: int, noun: str, text: str) -> None:
    assert counted(count, noun) == text


@pytest.mark.parametrize(
    ("count", "verb", "text"), [(1, "is", "1 byte is"), (2, "is", "2 bytes are"), (0, "was", "0 bytes were")]
)
def test_the_verb_follows_the_number(count: int, verb: Any, text: str) -> None:
    assert counted(count, "byte", verb) == text
