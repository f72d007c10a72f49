"""The table of personalities: what it says of each, and how it grows."""

import pytest

from busway import ConfigError
from busway.testing import CLIENT_PERSONALITIES, PERSONALITIES, Carrier, Fault, Personality, PersonalityTable

OF_THE_FIELD = (
    "late",
    "queue-lag",
    "foreign-transaction",
    "transaction+1",
    "transaction=0",
    "transaction=random",
    "unit=255",
    "unit=0",
    "unit=1",
    "mute-after-connect",
    "close-if-silent",
    "single-client",
    "idle-close",
    "wedged",
    "min-gap",
    "unit-switch",
    "max-block",
    "hole",
    "wide-register",
    "short",
    "long",
    "dribble",
    "glue",
    "busy",
    "execute-then-drop",
    "wrong-echo",
    "odd-exception",
    "fc6-only",
    "fc16-only",
)


def test_every_personality_met_on_tcp_is_there_under_its_name() -> None:
    assert tuple(PERSONALITIES) == OF_THE_FIELD
    assert tuple(CLIENT_PERSONALITIES) == ("slow-loris",)


@pytest.mark.parametrize("one", PERSONALITIES.values(), ids=list(PERSONALITIES))
def test_personality_says_what_happens_where_it_was_seen_and_what_a_client_does(one: Personality) -> None:
    assert one.happens
    assert one.answer
    assert one.seen_in
    assert all("#" in place for place in one.seen_in)
    assert Carrier.TCP in one.carriers
    fault = one()
    assert fault.name == one.name
    assert fault.admits or fault.asked or fault.answered or fault.closes_at


def test_options_have_defaults_and_one_that_there_is_not_is_named() -> None:
    assert dict(PERSONALITIES["late"].options) == {"delay": 1.5}
    with pytest.raises(ConfigError, match="delay") as caught:
        PERSONALITIES["late"](seconds=2)
    assert caught.value.key == "seconds"


def test_table_takes_more_personalities_and_stays_as_it_is_itself() -> None:
    noise = Personality("noise", "junk between frames", (), "slides on", Fault, frozenset({Carrier.SERIAL}))
    more = PERSONALITIES.with_personalities(noise)
    assert more["noise"] is noise
    assert len(more) == len(PERSONALITIES) + 1
    assert "noise" not in PERSONALITIES
    with pytest.raises(ConfigError, match="two personalities noise"):
        more.with_personalities(noise)


def test_unknown_name_lists_those_there_are() -> None:
    with pytest.raises(ConfigError, match="late, queue-lag"):
        PERSONALITIES.named("lazy")
    assert PERSONALITIES.named("late") is PERSONALITIES["late"]
    assert PersonalityTable().get("late") is None
