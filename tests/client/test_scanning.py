"""`busway.scan`: the units that answer, as a list."""

from collections.abc import Iterator

import pytest

import busway
from busway.client.scanning import FoundUnit
from busway.observe.sniffing import Listening, SniffedLine


@pytest.fixture
def url() -> Iterator[str]:
    """Units 3, which has the register that is asked for, and 7, which has not."""
    units = {3: busway.Device(holding_registers=1, server_id=b"pump"), 7: busway.Device(coils=1)}
    with busway.serve_in_thread("rtu+tcp://127.0.0.1:0", units=units) as server:
        yield server.endpoints[0]


def test_who_answers_is_found_with_how_and_who_it_is(url: str) -> None:
    found = busway.scan(url, [7, 3, 9, 3], timeout=0.3, listen=None)
    assert [(one.unit, one.answer) for one in found] == [(3, "answers"), (7, "answers with exception 02")]
    assert b"pump" in found[0].server_id
    assert all(0 < one.seconds < 0.3 for one in found)


def test_it_asks_no_unit_for_its_identification_where_that_is_not_wanted(url: str) -> None:
    (found,) = busway.scan(url, range(3, 4), timeout=0.3, listen=None, identify=False)
    assert found == FoundUnit(3, "answers", found.seconds)


def test_a_tcp_address_is_asked_for_every_unit_and_the_device_itself() -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=1)}) as server:
        found = busway.scan(server.endpoints[0], identify=False)
    assert [one.unit for one in found] == [1, 255]


@pytest.mark.parametrize(
    ("url", "arguments", "sentence"),
    [
        ("rtu+tcp://127.0.0.1:1", {"units": [0]}, "units: must be 1…247, not 0"),
        ("tcp://127.0.0.1:1", {"units": [256]}, "units: must be 0…255, not 256"),
        ("tcp://127.0.0.1:1", {"units": [1, "2"]}, "units: each must be an integer, not '2'"),
        ("tcp://127.0.0.1:1", {"units": [1.0]}, "units: each must be an integer, not 1.0"),
        ("tcp://127.0.0.1:1", {"units": []}, "units: at least one unit is needed"),
        ("tcp://127.0.0.1:1", {"timeout": 0}, "timeout: must be 0.001…60 seconds, not 0"),
        ("tcp://127.0.0.1:1", {"timout": 1}, "timout: unknown option of tcp://127.0.0.1:1; is it timeout?"),
    ],
)
def test_what_cannot_be_is_refused(url: str, arguments: dict[str, object], sentence: str) -> None:
    with pytest.raises(busway.ConfigError) as caught:
        busway.scan(url, **arguments)  # type: ignore[arg-type]
    assert str(caught.value) == sentence


@pytest.mark.parametrize(
    ("query", "options"),
    [
        ("", {"baud": 9600, "parity": "none", "retries": 2}),
        ("?baud=19200&parity=none&retries=2", {"baudrate": 9600}),
        ("?baudrate=9600&parity=none&queue=4", {}),
    ],
)
def test_a_line_is_listened_to_with_the_settings_of_the_scan(
    monkeypatch: pytest.MonkeyPatch, query: str, options: dict[str, object]
) -> None:
    heard: list[SniffedLine] = []

    class BusyLine(Listening):
        def __init__(self, line: SniffedLine) -> None:
            heard.append(line)
            self.bytes_heard = 1

        def close(self) -> None:
            pass

    monkeypatch.setattr("busway.observe.sniffing.Listening", BusyLine)
    with pytest.raises(busway.ConfigError, match="the line is busy"):
        busway.scan(f"rtu:///dev/ttyS0{query}", [1], **options)  # type: ignore[arg-type]
    assert [str(line.port) for line in heard] == ["9600 8N2"]


def test_without_a_listener_the_connection_is_down() -> None:
    with pytest.raises(busway.LinkDown):
        busway.scan("tcp://127.0.0.1:1", [1], timeout=0.2)
