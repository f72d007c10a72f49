"""Enums of options whose values are words: capitals are accepted too."""

import pytest

from busway.framing.character_times import Parity
from busway.framing.echo import Echo
from busway.options import ports


def test_a_word_is_taken_in_capitals_too_and_another_is_not() -> None:
    assert Parity("EVEN") is Parity("even") is Parity.EVEN
    for unknown in ("mark", "MARK", 7):
        with pytest.raises(ValueError, match="is not a valid"):
            Parity(unknown)


def test_parity_and_echo_of_a_port_are_those_of_the_framing() -> None:
    assert ports.Parity is Parity
    assert ports.Echo is Echo
