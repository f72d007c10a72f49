"""The sentence with which a value is refused."""

from busway.errors import InvalidRequest
from busway.values.unfit_values import shown, unfit


def test_a_value_is_shown_in_a_few_characters() -> None:
    assert shown("pump") == "'pump'"
    assert len(shown("x" * 10_000)) <= 61
    assert shown(10**6000) == "a number of thousands of digits"


def test_the_index_is_named_only_among_several_values() -> None:
    alone = unfit([7], 0, "bit", "nothing")
    among = unfit([1, 7], 1, "bit", "nothing", "; really")
    assert isinstance(alone, InvalidRequest)
    assert str(alone) == "7 does not fit bit, which takes nothing"
    assert str(among) == "values[1] = 7 does not fit bit, which takes nothing; really"
