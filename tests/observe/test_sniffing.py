"""Ears on a paced line and at a device server."""

import socket
import time
from collections.abc import Iterator

import pytest

from busway.errors import ConfigError, LinkDown
from busway.framing.ascii import encode_ascii
from busway.framing.character_times import FIXED_T3_5, SerialTiming
from busway.framing.rtu import encode_rtu
from busway.observe.pairing import Heard, Kind
from busway.observe.sniffing import DatagramByteSource, Listening, sniffed_line
from busway.testing.line import PacedLine
from busway.transport.serial import BlockingSerialPort

REQUEST, REPLY = bytes.fromhex("03 006b 0001"), bytes.fromhex("03 02 022b")
LIMIT = 10.0


def heard(listening: Listening, count: int) -> list[Heard]:
    """The next so many events."""
    events: list[Heard] = []
    limit = time.monotonic() + LIMIT
    while len(events) < count:
        assert time.monotonic() < limit, events
        events += listening.hear(limit)
    return events


@pytest.fixture
def line() -> Iterator[PacedLine]:
    with PacedLine(ports=2, baud=19_200) as line:
        yield line


@pytest.mark.parametrize(("scheme", "encode"), [("rtu", encode_rtu), ("ascii", encode_ascii)])
@pytest.mark.alone
def test_a_conversation_on_a_port_is_heard_in_pairs(line: PacedLine, scheme: str, encode: type) -> None:
    url = f"{scheme}://{line.paths[1]}?baud=19200"
    with (
        Listening(sniffed_line(url)) as listening,
        BlockingSerialPort(line.paths[0], line.settings) as talker,
    ):
        talker.write(encode(1, REQUEST))
        (asked,) = heard(listening, 1)
        talker.write(encode(1, REPLY))
        (answered,) = heard(listening, 1)
        assert (asked.kind, answered.kind) == (Kind.REQUEST, Kind.REPLY)
        assert asked.frame is not None
        assert asked.frame.pdu == REQUEST
        assert answered.request is asked.frame
        assert listening.bytes_heard == len(encode(1, REQUEST)) + len(encode(1, REPLY))
    assert {byte.port for byte in line.tap} == {0}  # the listener has sent nothing


@pytest.mark.alone
def test_what_is_unfinished_at_the_end_is_told(line: PacedLine) -> None:
    with Listening(sniffed_line(f"ascii://{line.paths[1]}")) as listening:
        line.inject(b":0103")
        limit = time.monotonic() + LIMIT
        while listening.bytes_heard < 5:
            assert time.monotonic() < limit
            assert listening.hear(limit) == []
        assert [event.kind for event in listening.finish()] == [Kind.DAMAGED]


@pytest.mark.alone
def test_a_line_that_vanishes_ends_the_listening(line: PacedLine) -> None:
    with Listening(sniffed_line(f"rtu://{line.paths[1]}")) as listening:
        line.unplug(1)
        with pytest.raises(LinkDown):
            heard(listening, 1)


@pytest.mark.alone
def test_a_port_that_this_process_uses_is_refused(line: PacedLine) -> None:
    heard_line = sniffed_line(f"rtu://{line.paths[1]}")
    with Listening(heard_line), pytest.raises(ConfigError, match="a listener to the line"):
        Listening(heard_line)
    Listening(heard_line).close()


def test_a_device_server_that_mirrors_a_line_is_heard() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with Listening(sniffed_line(f"rtu+tcp://127.0.0.1:{port}")) as listening:
            peer, _ = listener.accept()
            with peer:
                peer.sendall(encode_rtu(1, REQUEST) + encode_rtu(1, REPLY))
                assert [event.kind for event in heard(listening, 2)] == [Kind.REQUEST, Kind.REPLY]
            with pytest.raises(LinkDown, match="closed"):
                heard(listening, 1)


def test_a_device_server_is_connected_to_from_the_chosen_address() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"rtu+tcp://127.0.0.1:{listener.getsockname()[1]}"
        with Listening(sniffed_line(f"{url}?local_address=127.0.0.2")):
            peer, address = listener.accept()
            peer.close()
        assert address[0] == "127.0.0.2"
        with pytest.raises(LinkDown, match=r"local_address: '192\.0\.2\.1' is no address of this host") as caught:
            Listening(sniffed_line(f"{url}?local_address=192.0.2.1"))
    assert caught.value.kind == "local"


def test_a_server_that_is_not_there_is_no_connection() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(LinkDown):
        Listening(sniffed_line(f"rtu+tcp://127.0.0.1:{port}"))


def test_a_connection_that_cannot_be_configured_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> None:
        raise OSError("no such option")

    monkeypatch.setattr("busway.observe.sniffing.configure", refuse)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(LinkDown, match="no such option"):
            Listening(sniffed_line(f"rtu+tcp://127.0.0.1:{port}"))
        peer, _ = listener.accept()
        with peer:
            peer.settimeout(60)
            assert peer.recv(1) == b""


@pytest.mark.parametrize(("framing", "encode"), [("rtu", encode_rtu), ("ascii", encode_ascii)])
def test_datagrams_of_a_device_server_are_heard_where_they_arrive(framing: str, encode: type) -> None:
    with (
        Listening(sniffed_line(f"{framing}+udp://127.0.0.1:0?receive_buffer=4096")) as listening,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server,
    ):
        assert isinstance(listening._source, DatagramByteSource)
        there = "127.0.0.1", listening._source.port
        assert listening.hear(time.monotonic() + 0.01) == []
        server.sendto(encode(1, REQUEST), there)
        server.sendto(encode(1, REPLY), there)
        assert [event.kind for event in heard(listening, 2)] == [Kind.REQUEST, Kind.REPLY]


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
def test_datagrams_can_only_be_taken_at_this_machine(host: str) -> None:
    with pytest.raises(LinkDown, match="datagrams cannot be taken there"):
        Listening(sniffed_line(f"rtu+udp://{host}:4001"))


@pytest.mark.alone
def test_a_port_that_vanishes_is_heard_again_when_it_is_back(line: PacedLine) -> None:
    told: list[str] = []
    with Listening(
        sniffed_line(f"rtu://{line.paths[1]}?reopen_first=0.01&reopen_most=0.02"),
        vanished=lambda error: told.append(str(error)),
        returned=lambda: told.append("back"),
    ) as listening:
        line.inject(b"\x01\x03\x00")
        limit = time.monotonic() + LIMIT
        while listening.bytes_heard < 3:
            assert listening.hear(limit) == []
        line.unplug(1)
        (broken,) = heard(listening, 1)
        assert broken.kind is Kind.DAMAGED
        assert listening.lost is not None
        for _ in range(5):
            assert listening.hear(time.monotonic() + 0.01) == []
        assert listening.finish() == []
        line.replug(1)
        while listening.lost is not None:
            assert time.monotonic() < limit
            listening.hear(limit)
        assert [said == "back" for said in told] == [False, True]
        with BlockingSerialPort(line.paths[0], line.settings) as talker:
            talker.write(encode_rtu(1, REQUEST))
            assert [event.kind for event in heard(listening, 1)] == [Kind.REQUEST]


def test_nothing_is_heard_in_silence() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with Listening(sniffed_line(f"ascii+tcp://127.0.0.1:{port}")) as listening:
            assert listening.hear(time.monotonic() + 0.01) == []


def test_the_times_of_a_line_are_those_of_its_settings() -> None:
    line = sniffed_line("rtu:///dev/ttyS0?baud=115200&parity=none")
    assert line.timing.t3_5 == FIXED_T3_5
    assert line.timing.character == pytest.approx(11 / 115_200)
    assert sniffed_line("rtu+tcp://host:1").timing == SerialTiming.of_network()
    ascii_line = sniffed_line("ascii:///dev/ttyS0")
    assert ascii_line.port is not None
    assert ascii_line.port.data_bits == 7


def test_a_listener_hears_by_the_preset_too() -> None:
    assert sniffed_line("rtu:///dev/ttyS0?preset=strict").framing.strict_timing
    assert sniffed_line("ascii+udp://:4001?preset=strict").framing.upper_case_only


@pytest.mark.parametrize(
    ("url", "complaint"),
    [
        ("tcp://10.0.0.5", "only a line"),
        ("udp://10.0.0.5:4001", "only a line"),
        ("rtu+tcp://:4001", "the host is missing"),
        ("rtu+udp://:4001?keepalive=off", "keepalive: unknown option"),
        ("rtu+tcp://10.0.0.5:4001?strict_timing=on", "strict_timing: unknown option"),
        ("rtu:///dev/ttyS0?delimiter=3", "delimiter: unknown option"),
        ("rtu:///dev/ttyS0?port_wait=3", "port_wait: unknown option"),
        ("rtu:///dev/ttyS0?preset=strict&mark_errors=off", "mark_errors: does not go with the preset"),
        ("rtu:///dev/ttyS0?baud=12", "baud"),
        ("rtu:///dev/ttyS0?timeout=2", "timeout: unknown option"),
        ("rtu+tcp://10.0.0.5:4001?baud=9600", "baud: unknown option"),
        ("rtu:///dev/ttyS0?data_bits=7", "data_bits"),
    ],
)
def test_a_line_that_cannot_be_heard_is_refused(url: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        sniffed_line(url)
