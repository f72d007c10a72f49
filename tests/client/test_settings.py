"""What a link is set to where nothing is said."""

import pytest

from busway.apps.collector.configuration import LINK_DEFAULTS
from busway.apps.gateway.gateway_plan import UPSTREAM_DEFAULTS
from busway.client.settings import LinkSettings, link_settings, with_defaults
from busway.errors import ConfigError
from busway.framing.character_times import Parity
from busway.options.accepted_options import LINKS, AcceptedOptions
from busway.options.declaration import declared
from busway.options.endpoints import parse_endpoint
from busway.options.presets import names_set_by


@pytest.mark.parametrize(
    ("url", "timeout"),
    [
        ("tcp://10.0.0.5", 3.0),
        ("tls://10.0.0.5", 3.0),
        ("udp://10.0.0.5", 3.0),
        ("rtu:///dev/ttyX", 1.0),
        ("ascii:///dev/ttyX", 1.0),
        ("rtu+tcp://10.0.0.5:4001", 1.0),
        ("tcp://10.0.0.5?timeout=1", 1.0),
    ],
)
def test_a_client_waits_for_a_gateway_longer_than_for_a_unit_on_a_line(url: str, timeout: float) -> None:
    assert link_settings(url, {}).parameters.timeout == timeout


def test_an_option_goes_before_the_default_of_the_scheme() -> None:
    assert link_settings("tcp://10.0.0.5", {"timeout": 0.5}).parameters.timeout == 0.5


@pytest.mark.parametrize(
    ("url", "options"),
    [
        ("rtu:///dev/ttyX", {"baudrate": 9600, "bytesize": 8, "parity": "N", "stopbits": 1}),
        ("rtu:///dev/ttyX?baudrate=9600&bytesize=8&parity=n&stopbits=1", {}),
        ("rtu:///dev/ttyX?baudrate=2400", {"baud": 9600, "data_bits": 8, "parity": "none", "stop_bits": 1}),
    ],
)
def test_a_line_is_set_by_the_words_of_pyserial_too(url: str, options: dict[str, object]) -> None:
    line = link_settings(url, options).line
    assert line is not None
    assert line.port is not None
    assert str(line.port) == "9600 8N1"


@pytest.mark.parametrize(("letter", "parity"), [("N", Parity.NONE), ("E", Parity.EVEN), ("o", Parity.ODD)])
def test_a_letter_stands_for_a_parity(letter: str, parity: Parity) -> None:
    line = link_settings("rtu:///dev/ttyX", {"parity": letter}).line
    assert line is not None
    assert line.port is not None
    assert line.port.parity is parity


@pytest.mark.parametrize(
    ("url", "option", "sentence"),
    [
        ("tcp://h", "timout", "timout: unknown option of tcp://h:502; is it timeout?"),
        ("tcp://h", "Retries", "Retries: unknown option of tcp://h:502; is it retries?"),
        ("tcp://h", "retry", "retry: unknown option of tcp://h:502; is it retries?"),
        ("rtu:///dev/ttyX", "stopbit", "stopbit: unknown option of rtu:///dev/ttyX; is it stop_bits?"),
        ("rtu:///dev/ttyX", "speed", "speed: unknown option of rtu:///dev/ttyX; is it baud?"),
        ("rtu:///dev/ttyX", "baudrat", "baudrat: unknown option of rtu:///dev/ttyX; is it baud?"),
        ("rtu:///dev/ttyX", "byte_size", "byte_size: unknown option of rtu:///dev/ttyX; is it data_bits?"),
        ("tcp://h", "slave", "slave: unknown option of tcp://h:502; a unit is named where it is asked: link.unit(1)"),
    ],
)
def test_the_option_that_is_meant_is_named_and_not_all_there_are(url: str, option: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        link_settings(url, {option: 1})
    assert str(caught.value) == sentence


def test_an_option_like_no_other_is_answered_with_all_there_are() -> None:
    with pytest.raises(
        ConfigError, match=r"colour: unknown option of tcp://h:502; there are .*connect_timeout, deadline, "
    ):
        link_settings("tcp://h", {"colour": "red"})


def test_an_option_under_both_of_its_names_is_refused() -> None:
    with pytest.raises(ConfigError, match="baudrate: is another name of baud, which is given too"):
        link_settings("rtu:///dev/ttyX", {"baud": 9600, "baudrate": 9600})


def _values(settings: LinkSettings) -> dict[str, object]:
    return {name: getattr(part, name) for part in settings._parts() for name in declared(type(part))}


@pytest.mark.parametrize("defaults", [UPSTREAM_DEFAULTS, LINK_DEFAULTS])
@pytest.mark.parametrize("preset", ["strict", "passive", "PASSIVE"])
@pytest.mark.parametrize(
    "url",
    [
        "tcp://10.0.0.5",
        "tls://10.0.0.5",
        "udp://10.0.0.5",
        "rtu+tcp://10.0.0.5:4001",
        "ascii+tcp://10.0.0.5:4001",
        "rtu:///dev/ttyX",
        "ascii:///dev/ttyX",
    ],
)
def test_the_defaults_of_a_program_change_nothing_that_a_preset_sets(
    url: str, preset: str, defaults: dict[str, object]
) -> None:
    accepted = AcceptedOptions.at(parse_endpoint(url), "client", LINKS)
    alone = _values(link_settings(url, {"preset": preset}))
    for where, options in ((f"{url}?preset={preset}", {}), (url, {"preset": preset})):
        found = _values(link_settings(where, with_defaults(parse_endpoint(where), options, defaults)))
        for name, value in found.items():
            if name in names_set_by(preset, accepted.options) or name not in defaults:
                assert value == alone[name], name
            elif name in accepted.names:
                assert value == defaults[name], name
