"""Numbers, times and values that look like options, as people write them."""

import pytest

from busway import ConfigError
from busway.cli.arguments import refuse_unknown_option, seconds, whole_number


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("500ms", 0.5),
        ("1s", 1.0),
        ("2", 2.0),
        ("1.5 s", 1.5),
        (".5s", 0.5),
        ("2m", 120.0),
        ("2min", 120.0),
        ("1h", 3600.0),
    ],
)
def test_a_time(text: str, expected: float) -> None:
    assert seconds(text, "--watch") == expected


@pytest.mark.parametrize("text", ["", "s", "1 day", "-1s", "1e3", "nan", "0", "25h", "1,5s"])
def test_what_is_no_time_is_refused_by_the_name_of_its_option(text: str) -> None:
    with pytest.raises(ConfigError, match="--watch: a time"):
        seconds(text, "--watch")


@pytest.mark.parametrize(("text", "expected"), [("0", 0), ("247", 247), ("0xF7", 247)])
def test_a_number(text: str, expected: int) -> None:
    assert whole_number(text, "--unit", 0, 255) == expected


@pytest.mark.parametrize("text", ["", "256", "-1", "1.0", "x", "0x", "1_0", "9" * 5000])
def test_what_is_no_number_in_range_is_refused_by_the_name_of_its_option(text: str) -> None:
    with pytest.raises(ConfigError, match="--unit: a whole number 0…255"):
        whole_number(text, "--unit", 0, 255)


@pytest.mark.parametrize("value", ["-5", "-0.5", "-.5", "-0x10", "-inf", "-Infinity", "-nan", "on", "-", "--5"])
def test_what_begins_with_a_minus_sign_may_be_a_value(value: str) -> None:
    refuse_unknown_option(value)


@pytest.mark.parametrize("value", ["--tpye", "-x", "--unknown=3"])
def test_a_misspelt_option_is_no_value(value: str) -> None:
    with pytest.raises(ConfigError, match="there is no such option"):
        refuse_unknown_option(value)
