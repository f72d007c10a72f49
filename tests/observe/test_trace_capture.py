"""Links and servers whose traffic goes into a capture file."""

import io
import logging
from collections.abc import Iterator

import pytest
from capture_file import blocks

import busway
from busway.framing.rtu import encode_rtu
from busway.observe.capture import Capture
from busway.observe.capture_headers import Node, tcp_packet, udp_packet
from busway.observe.connection_trace import trace_for
from busway.observe.socket_addresses import SocketAddresses
from busway.observe.trace import TRACE, TraceLevel

HERE, PEER = ("10.0.0.1", 40_000), ("10.0.0.5", 502)
ASKED, ANSWERED = bytes.fromhex("0001 0000 0006 ff 03 006b 0001"), bytes.fromhex("0001 0000 0005 ff 03 02 022b")


@pytest.fixture
def file() -> Iterator[io.BytesIO]:
    """What the process captures into for the time of a test."""
    file = io.BytesIO()
    TRACE.capture_into(Capture(file))
    yield file
    TRACE.capture_into(None)


def packets(file: io.BytesIO) -> list[bytes]:
    """The data of the packets."""
    found = [body for kind, body in blocks(file.getvalue()) if kind == 6]
    return [body[20 : 20 + int.from_bytes(body[12:16], "little")] for body in found]


def test_capturing_switches_the_drivers_test_on_and_shows_nothing(
    file: io.BytesIO, caplog: pytest.LogCaptureFixture
) -> None:
    assert TRACE.level
    with caplog.at_level(logging.DEBUG, "busway.trace"):
        for framing in ("mbap", "rtu"):
            trace = trace_for(framing, "peer", is_server=False, carrier=SocketAddresses(HERE, PEER))
            trace.sent(ASKED)
            trace.received(ANSWERED)
    assert not caplog.records
    TRACE.capture_into(None)
    assert TRACE.level is TraceLevel.OFF


def test_log_lines_and_a_capture_go_together(file: io.BytesIO, caplog: pytest.LogCaptureFixture) -> None:
    TRACE.set(TraceLevel.MESSAGE)
    with caplog.at_level(logging.DEBUG, "busway.trace"):
        trace_for("mbap", "peer", is_server=False, carrier=SocketAddresses(HERE, PEER)).sent(ASKED)
    TRACE.set(TraceLevel.OFF)
    assert TRACE.level is TraceLevel.CAPTURE
    assert len(caplog.records) == 1
    assert packets(file) == [tcp_packet(Node.of(HERE), Node.of(PEER), ASKED, 1, 1)]


def test_datagrams_stay_datagrams(file: io.BytesIO) -> None:
    trace = trace_for("mbap", "peer", is_server=True, carrier=SocketAddresses(HERE, PEER, is_datagram=True))
    trace.received(ASKED)
    trace.sent(ANSWERED)
    here, peer = Node.of(HERE), Node.of(PEER)
    assert packets(file) == [udp_packet(peer, here, ASKED), udp_packet(here, peer, ANSWERED)]


def test_the_frames_of_a_line_are_found_in_its_pieces(file: io.BytesIO) -> None:
    trace = trace_for("rtu", "rtu:///dev/ttyS0", is_server=False)
    request, reply = encode_rtu(1, ASKED[7:]), encode_rtu(1, ANSWERED[7:])
    trace.sent(request)
    trace.received(reply[:3])
    trace.received(reply[3:])
    assert [packet.endswith(frame) for packet, frame in zip(packets(file), (request, reply), strict=True)] == [
        True,
        True,
    ]


def test_client_and_server_of_one_process_are_captured_with_their_true_ports(file: io.BytesIO) -> None:
    device = busway.Device(holding_registers=1)
    with (
        busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device}) as server,
        busway.connect(server.endpoints[0]) as link,
    ):
        port = int(server.endpoints[0].rpartition(":")[2])
        link.unit(1).read_holding_registers(0, count=1)
    ends = [(int.from_bytes(each[20:22], "big"), int.from_bytes(each[22:24], "big")) for each in packets(file)]
    assert len(ends) == 4  # each of both sides captures the request and the reply
    (client,) = {source for source, _ in ends} - {port}
    assert sorted(ends) == sorted([(client, port), (port, client)] * 2)


async def test_an_asyncio_link_is_captured(file: io.BytesIO) -> None:
    device = busway.Device(holding_registers=1)
    async with (
        busway.serve("tcp://127.0.0.1:0", units={1: device}) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        await link.unit(1).read_holding_registers(0, count=1)
    assert len(packets(file)) == 4
