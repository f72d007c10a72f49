"""The table of fault profiles: what it says of each, and how it grows."""

import pytest
from field_faults import OF_SERVERS

from busway import ConfigError
from busway.testing import CLIENT_FAULT_PROFILES, FAULT_PROFILES, Carrier, Fault, FaultProfile, FaultProfileTable


def test_every_fault_profile_of_a_server_is_there_under_its_name() -> None:
    assert tuple(FAULT_PROFILES) == OF_SERVERS
    assert tuple(CLIENT_FAULT_PROFILES) == ("slow-loris",)


@pytest.mark.parametrize("one", FAULT_PROFILES.values(), ids=list(FAULT_PROFILES))
def test_fault_profile_says_what_happens_where_it_was_seen_and_what_a_client_does(one: FaultProfile) -> None:
    assert one.happens
    assert one.answer
    assert one.seen_in
    assert all("#" in place for place in one.seen_in)
    assert one.carriers
    fault = one()
    assert fault.name == one.name
    assert fault.admits or fault.asked or fault.answered or fault.closes_at


def test_options_have_defaults_and_one_that_there_is_not_is_named() -> None:
    assert dict(FAULT_PROFILES["late"].options) == {"delay": 1.5}
    with pytest.raises(ConfigError, match="delay") as caught:
        FAULT_PROFILES["late"](seconds=2)
    assert caught.value.key == "seconds"


def test_table_takes_more_fault_profiles_and_stays_as_it_is_itself() -> None:
    sulky = FaultProfile("sulky", "says nothing on Mondays", (), "waits", Fault, frozenset({Carrier.SERIAL}))
    more = FAULT_PROFILES.with_fault_profiles(sulky)
    assert more["sulky"] is sulky
    assert len(more) == len(FAULT_PROFILES) + 1
    assert "sulky" not in FAULT_PROFILES
    with pytest.raises(ConfigError, match="two fault profiles sulky"):
        more.with_fault_profiles(sulky)


def test_unknown_name_lists_those_there_are() -> None:
    with pytest.raises(ConfigError, match="late, queue-lag"):
        FAULT_PROFILES.named("lazy")
    assert FAULT_PROFILES.named("late") is FAULT_PROFILES["late"]
    assert FaultProfileTable().get("late") is None


@pytest.mark.parametrize("one", FAULT_PROFILES.values(), ids=list(FAULT_PROFILES))
def test_options_say_what_they_mean_and_their_defaults_are_within_their_ranges(one: FaultProfile) -> None:
    for parameter in one.parameters.values():
        assert parameter.kinds[0] in (float, int, bool)
        assert parameter.help
        assert (parameter.limits is None) is (parameter.kinds == (bool,))
        parameter.check(parameter.default)


@pytest.mark.parametrize(
    ("name", "options", "sentence"),
    [
        ("late", {"delay": "2"}, "must be a number, not '2'"),
        ("late", {"delay": True}, "must be a number, not True"),
        ("late", {"delay": -0.1}, "must be 0…86400, not -0.1"),
        ("late", {"delay": float("nan")}, "must be 0…86400, not nan"),
        ("late", {"delay": None}, "must be a number, not None"),
        ("max-block", {"items": 1.5}, "must be a whole number, not 1.5"),
        ("queue-lag", {"connections": -1}, "must be at least 0, not -1"),
        ("single-client", {"starve": 1}, "must be true or false, not 1"),
        ("wide-register", {"size": 13}, "must be 4…12, not 13"),
    ],
)
def test_option_of_a_wrong_type_or_out_of_range_is_refused(
    name: str, options: dict[str, object], sentence: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        FAULT_PROFILES[name](**options)
    assert caught.value.message == sentence
    assert caught.value.key == next(iter(options))


def test_options_take_whole_numbers_for_times_and_nothing_where_that_is_a_value() -> None:
    assert FAULT_PROFILES["late"](delay=2).name == "late"
    assert FAULT_PROFILES["busy"](seconds=None).name == "busy"
