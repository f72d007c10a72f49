"""URLs of peers and lines: what each scheme means, defaults, and the errors of invalid URLs."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.errors import ConfigError
from busway.options.endpoints import SCHEMES, Endpoint, parse_endpoint


@pytest.mark.clause("T3")
@pytest.mark.parametrize(
    ("url", "host", "port", "framing", "carrier", "name"),
    [
        ("tcp://10.0.0.5", "10.0.0.5", 502, "mbap", "tcp", "tcp://10.0.0.5:502"),
        ("tcp://10.0.0.5:1502", "10.0.0.5", 1502, "mbap", "tcp", "tcp://10.0.0.5:1502"),
        ("tcp://plc-3.example", "plc-3.example", 502, "mbap", "tcp", "tcp://plc-3.example:502"),
        ("TCP://Plc", "plc", 502, "mbap", "tcp", "tcp://plc:502"),
        ("tcp://[::1]", "::1", 502, "mbap", "tcp", "tcp://[::1]:502"),
        ("tcp://[fe80::1%eth0]:5020", "fe80::1%eth0", 5020, "mbap", "tcp", "tcp://[fe80::1%eth0]:5020"),
        ("tcp://:5020", "", 5020, "mbap", "tcp", "tcp://:5020"),
        ("tcp://", "", 502, "mbap", "tcp", "tcp://:502"),
        ("tcp://host/", "host", 502, "mbap", "tcp", "tcp://host:502"),
        ("tcp://host:0", "host", 0, "mbap", "tcp", "tcp://host:0"),
        ("tls://host", "host", 802, "mbap", "tls", "tls://host:802"),
        ("udp://host", "host", 502, "mbap", "udp", "udp://host:502"),
        ("rtu+tcp://host:4001", "host", 4001, "rtu", "tcp", "rtu+tcp://host:4001"),
        ("ascii+tcp://host:4001", "host", 4001, "ascii", "tcp", "ascii+tcp://host:4001"),
        ("rtu+udp://host:4001", "host", 4001, "rtu", "udp", "rtu+udp://host:4001"),
        ("ascii+udp://host:4001", "host", 4001, "ascii", "udp", "ascii+udp://host:4001"),
    ],
)
def test_a_network_endpoint(url: str, host: str, port: int, framing: str, carrier: str, name: str) -> None:
    endpoint = parse_endpoint(url)
    assert (endpoint.host, endpoint.port, endpoint.path) == (host, port, "")
    assert (endpoint.framing, endpoint.carrier) == (framing, carrier)
    assert endpoint.url == str(endpoint) == name
    assert parse_endpoint(name) == endpoint


@pytest.mark.parametrize(
    ("url", "path", "framing", "name"),
    [
        ("rtu:///dev/ttyUSB0", "/dev/ttyUSB0", "rtu", "rtu:///dev/ttyUSB0"),
        ("ascii:///dev/ttyS1", "/dev/ttyS1", "ascii", "ascii:///dev/ttyS1"),
        ("rtu:///dev/my%20port", "/dev/my port", "rtu", "rtu:///dev/my%20port"),
        ("rtu:///usb:0403:6001:A5", "/usb:0403:6001:A5", "rtu", "rtu:///usb:0403:6001:A5"),
    ],
)
def test_a_serial_endpoint(url: str, path: str, framing: str, name: str) -> None:
    endpoint = parse_endpoint(url)
    assert (endpoint.path, endpoint.host, endpoint.port) == (path, "", None)
    assert (endpoint.framing, endpoint.carrier, endpoint.url) == (framing, "serial", name)


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("10.0.0.5", "tcp://10.0.0.5:502"),
        ("10.0.0.5:5020", "tcp://10.0.0.5:5020"),
        ("10.0.0.5?timeout=2", "tcp://10.0.0.5:502?timeout=2"),
        ("[::1]:5020", "tcp://[::1]:5020"),
        ("fe80::1", "tcp://[fe80::1]:502"),
        ("rtu://COM3", "rtu:///COM3"),
        ("ascii://COM3?baud=9600", "ascii:///COM3?baud=9600"),
    ],
)
def test_a_text_that_can_mean_one_endpoint_only_is_that_endpoint(text: str, url: str) -> None:
    assert str(parse_endpoint(text)) == url


def test_options_are_kept_as_text_with_underscores_and_are_not_part_of_the_name() -> None:
    endpoint = parse_endpoint("rtu:///dev/ttyUSB0?baud=19200&parity=even&stop-bits=1&note=a%20b&empty=")
    assert dict(endpoint.options) == {"baud": "19200", "parity": "even", "stop_bits": "1", "note": "a b", "empty": ""}
    assert endpoint.url == "rtu:///dev/ttyUSB0"
    assert parse_endpoint(str(endpoint)) == endpoint


def test_an_endpoint_is_given_back_as_it_is() -> None:
    endpoint = Endpoint("tcp", "host", 502)
    assert parse_endpoint(endpoint) is endpoint
    assert hash(endpoint) == hash(parse_endpoint("tcp://host?timeout=2")), "options do not tell endpoints apart"


@pytest.mark.parametrize(
    ("url", "sentence"),
    [
        ("plc.local", "'plc.local' is no endpoint; is it tcp://plc.local? A serial port is written rtu:///dev/ttyUSB0"),
        ("plc:5020", "'plc:5020' is no endpoint; is it tcp://plc:5020?"),
        ("tcp:10.0.0.5", "'tcp:10.0.0.5' is no endpoint; is it tcp://10.0.0.5?"),
        ("rtu:/dev/ttyUSB0", "'rtu:/dev/ttyUSB0' is no endpoint; is it rtu:///dev/ttyUSB0?"),
        ("usb:0403:6001", "'usb:0403:6001' is no endpoint; is it rtu:///usb:0403:6001, or ascii:///usb:0403:6001?"),
        ("COM3", "'COM3' is no endpoint; is it rtu:///COM3, or ascii:///COM3?"),
        ("com12?baud=9600", "'com12?baud=9600' is no endpoint; is it rtu:///com12, or ascii:///com12?"),
        ("/dev/ttyUSB0", "'/dev/ttyUSB0' is no endpoint; is it rtu:///dev/ttyUSB0, or ascii:///dev/ttyUSB0?"),
        ("a b", "'a b' is no endpoint; write for example tcp://192.168.0.5 or rtu:///dev/ttyUSB0"),
        ("tpc://10.0.0.5", "tpc://10.0.0.5: unknown scheme 'tpc'; is it tcp://10.0.0.5?"),
        ("modbus://10.0.0.5", "modbus://10.0.0.5: unknown scheme 'modbus'; is it tcp://10.0.0.5?"),
        ("", "'' is no endpoint"),
        (None, "None is no endpoint"),
        ("http://host", "http://host: unknown scheme 'http'; there are tcp, tls"),
        ("tcp://host:port", "tcp://host:port: the port must be 0…65535, not 'port'"),
        ("tcp://host:65536", "tcp://host:65536: the port must be 0…65535, not '65536'"),
        ("tcp://host:-1", "tcp://host:-1: the port must be 0…65535, not '-1'"),
        ("tcp://host/path", "tcp://host/path: a network endpoint has no path /path"),
        ("tcp://user@host", "tcp://user@host: an endpoint has no user name"),
        ("tcp://host#1", "tcp://host#1: an endpoint has no #1"),
        ("tcp://ho st", "tcp://ho st: 'ho st' is no host name"),
        ("tcp://::1", "tcp://::1: an IPv6 address stands in brackets, as in tcp://[fe80::1]"),
        ("tcp://[::1", "tcp://[::1: an IPv6 address stands in brackets, as in tcp://[fe80::1]"),
        ("tcp://[::g]", "tcp://[::g]: an IPv6 address stands in brackets"),
        (
            "rtu://dev/ttyUSB0",
            "rtu://dev/ttyUSB0: a serial line is rtu:///dev/… with three slashes; is it rtu:///dev/ttyUSB0?",
        ),
        ("rtu://", "rtu://: the path of the serial port is missing, as in rtu:///dev/ttyUSB0"),
        ("rtu+tcp://host", "rtu+tcp://host: the port is missing; rtu+tcp has no usual one"),
        ("tcp://host?timeout", "tcp://host?timeout: the options behind ? are name=value pairs joined by &"),
        ("tcp://host?a-b=1&a_b=2", "the option a_b is given twice"),
    ],
)
def test_what_is_no_endpoint_is_said_with_the_url_and_the_reason(url: object, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_endpoint(url)  # type: ignore[arg-type]
    assert sentence in str(caught.value)


def test_an_option_that_stands_twice_is_named() -> None:
    with pytest.raises(ConfigError) as caught:
        parse_endpoint("tcp://host?timeout=1&timeout=2")
    assert caught.value.key == "timeout"


@given(st.text(max_size=40), st.sampled_from([f"{scheme}://" for scheme in SCHEMES]))
def test_any_text_is_an_endpoint_or_a_configuration_error(text: str, scheme: str) -> None:
    for url in (text, scheme + text, f"{scheme}host:{text}", f"{scheme}host?{text}", f"{scheme}[{text}]:1"):
        try:
            endpoint = parse_endpoint(url)
        except ConfigError:
            continue
        assert parse_endpoint(str(endpoint)) == endpoint


def test_port_of_thousands_of_digits_is_refused_in_a_sentence_of_ours() -> None:
    with pytest.raises(ConfigError) as refused:
        parse_endpoint("tcp://127.0.0.1:" + "9" * 5000)
    assert str(refused.value).endswith(f"…: the port must be 0…65535, not '{'9' * 60}…'")
    assert len(str(refused.value)) < 200


LONG = "x" * 5000


@pytest.mark.parametrize(
    "url",
    [
        LONG,
        LONG.encode(),
        f"foo://{LONG}",
        f"{LONG}://host",
        f"tcp:{LONG}",
        f"/dev/{LONG}",
        f"tcp://host#{LONG}",
        f"tcp://user@{LONG}",
        f"tcp://host/{LONG}",
        f"tcp:// {LONG}",
        f"tcp://[{LONG}",
        f"tcp://host:{LONG}",
        f"tcp://::{LONG}",
        f"rtu+tcp://{LONG}",
        f"rtu://{LONG}",
        f"rtu://?a={LONG}",
        f"tcp://host?{LONG}",
        f"tcp://host?{LONG}=1&{LONG}=2",
    ],
)
def test_no_error_shows_a_long_url_in_full(url: object) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_endpoint(url)  # type: ignore[arg-type]
    assert len(str(refused.value)) < 400
