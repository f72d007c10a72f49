"""The known name that an unknown one was probably meant to be."""

import pytest

from busway.values.similar_names import similar_name


@pytest.mark.parametrize(("unknown", "meant"), [("timout", "timeout"), ("retires", "retries"), ("timeout", "timeout")])
def test_a_name_with_a_typing_error_is_recognised(unknown: str, meant: str) -> None:
    assert similar_name(unknown, {"timeout": 1, "retries": 2, "queue": 3}) == meant


def test_of_several_similar_names_the_most_similar_one_is_meant() -> None:
    assert similar_name("stop_bit", iter(["start_bits", "stop_bits", "data_bits"])) == "stop_bits"


@pytest.mark.parametrize("known", [(), ("queue", "hold")])
def test_where_no_name_is_similar_none_is_meant(known: tuple[str, ...]) -> None:
    assert similar_name("timeout", known) is None


def test_how_similar_a_name_must_be_can_be_chosen() -> None:
    assert similar_name("profile", ["file"]) == "file"
    assert similar_name("profile", ["file"], 0.75) is None
