"""The settings of a line: defaults, rules, refusals."""

import pytest

from busway.errors import ConfigError
from busway.options.ports import Echo, Parity, Rs485, SerialSettings


def test_the_defaults_are_those_of_the_specification() -> None:
    settings = SerialSettings()
    assert (settings.baud, settings.parity, settings.data_bits, settings.stop_bits_on_line) == (
        19_200,
        Parity.EVEN,
        8,
        1,
    )
    assert str(settings) == "19200 8E1"


@pytest.mark.parametrize(
    ("parity", "data_bits", "stop_bits", "character"),
    [
        (Parity.EVEN, 8, None, 11),
        (Parity.ODD, 8, None, 11),
        (Parity.NONE, 8, None, 11),  # the second stop bit takes the place of parity
        (Parity.EVEN, 7, None, 10),
        (Parity.NONE, 7, None, 10),
        (Parity.NONE, 8, 1, 10),
        (Parity.EVEN, 8, 2, 12),
    ],
)
def test_stop_bits_follow_the_rule_unless_they_are_given(
    parity: Parity, data_bits: int, stop_bits: int | None, character: int
) -> None:
    settings = SerialSettings(baud=9600, parity=parity, data_bits=data_bits, stop_bits=stop_bits)
    assert settings.character_bits == character
    assert settings.character_time == character / 9600


def test_options_of_a_url_become_settings() -> None:
    settings = SerialSettings.from_options(
        {
            "baud": "115200",
            "parity": "Odd",
            "stop_bits": "1",
            "rs485": "automatic",
            "delay_after_send": "0.001",
            "rts_on_send": "off",
            "rts_after_send": "on",
            "echo": "on",
            "low_latency": "no",
        }
    )
    assert settings == SerialSettings(
        baud=115_200,
        parity=Parity.ODD,
        stop_bits=1,
        rs485=Rs485.AUTOMATIC,
        delay_after_send=0.001,
        rts_on_send=False,
        rts_after_send=True,
        echo=Echo.ON,
        low_latency=False,
    )


def test_a_line_of_text_has_7_data_bits_unless_told_otherwise() -> None:
    assert SerialSettings.from_options({}, binary=False).data_bits == 7
    assert SerialSettings.from_options({"data_bits": "8"}, binary=False).data_bits == 8
    assert SerialSettings.from_options({}).data_bits == 8


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"baud": "0"}, "baud"),
        ({"baud": "fast"}, "baud"),
        ({"parity": "mark"}, "parity"),
        ({"parity": "MARK"}, "parity"),
        ({"data_bits": "9"}, "data_bits"),
        ({"data_bits": "7"}, "data_bits"),
        ({"stop_bits": "3"}, "stop_bits"),
        ({"rs485": "perhaps"}, "rs485"),
        ({"rs485": "rts", "delay_before_send": "-1"}, "delay_before_send"),
        ({"rs485": "rts", "delay_after_send": "2"}, "delay_after_send"),
        ({"rs485": "rts", "delay_after_send": "nan"}, "delay_after_send"),
        ({"delay_after_send": "0.1"}, "delay_after_send"),
        ({"rts_after_send": "on"}, "rts_after_send"),
        ({"exclusive": "maybe"}, "exclusive"),
        ({"baudrate": "9600"}, "baudrate"),
    ],
)
def test_an_impossible_setting_is_refused_and_named(options: dict[str, object], key: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        SerialSettings.from_options(options)
    assert refusal.value.key == key
