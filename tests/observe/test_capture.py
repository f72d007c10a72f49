"""What goes into a capture file, and that capturing disturbs no conversation."""

import io
import logging
import threading
from ipaddress import IPv4Address
from pathlib import Path

import pytest
from capture_file import blocks, options

from busway.framing.ascii import encode_ascii
from busway.framing.received import Damage, Damaged, Direction, SerialFrame
from busway.framing.rtu import encode_rtu
from busway.observe.capture import LARGEST_SEGMENT, Capture
from busway.observe.capture_headers import Node, line_pdu, tcp_packet, udp_packet

HERE, PEER = ("10.0.0.1", 40_000), ("10.0.0.5", 502)
MASTER = Node(IPv4Address(0), 50_000)
ADU = bytes.fromhex("0001 0000 0006 ff 03 006b 0003")


def packets(stream: io.BytesIO) -> list[tuple[bytes, str]]:
    """Data and comment of the packets."""
    found = []
    for kind, body in blocks(stream.getvalue()):
        if kind == 6:
            size = int.from_bytes(body[12:16], "little")
            rest = body[20 + size + -size % 4 :]
            found.append((body[20 : 20 + size], options(rest).get(1, b"").decode() if rest else ""))
    return found


def unit(number: int) -> Node:
    return Node(IPv4Address(number), 1)


def test_both_ways_of_a_connection_count_on_in_one_stream() -> None:
    file = io.BytesIO()
    stream = Capture(file).stream(HERE, PEER)
    stream.sent(ADU)
    stream.received(b"\x00\x01")
    stream.received(b"\x00\x00")
    here, peer = Node.of(HERE), Node.of(PEER)
    assert packets(file) == [
        (tcp_packet(here, peer, ADU, 1, 1), ""),
        (tcp_packet(peer, here, b"\x00\x01", 1, 13), ""),
        (tcp_packet(peer, here, b"\x00\x00", 3, 13), ""),
    ]


def test_a_large_receive_becomes_several_segments() -> None:
    file = io.BytesIO()
    Capture(file).stream(HERE, PEER).received(bytes(LARGEST_SEGMENT + 1))
    assert [len(data) - 40 for data, _ in packets(file)] == [LARGEST_SEGMENT, 1]


def test_a_datagram_is_one_packet() -> None:
    file = io.BytesIO()
    capture = Capture(file)
    capture.datagram(HERE, PEER, ADU, is_outgoing=True)
    capture.datagram(HERE, PEER, ADU, is_outgoing=False)
    here, peer = Node.of(HERE), Node.of(PEER)
    assert [data for data, _ in packets(file)] == [udp_packet(here, peer, ADU), udp_packet(peer, here, ADU)]


def test_request_and_reply_on_a_line_go_between_the_master_and_the_unit() -> None:
    file = io.BytesIO()
    line = Capture(file).line("rtu:///dev/ttyS0")
    request, reply = encode_rtu(7, b"\x06\x00\x01\x00\x03"), encode_rtu(7, b"\x06\x00\x01\x00\x03")
    line.heard(SerialFrame(7, request[1:-2], request, Direction.REQUEST, 0.9, 1.0), is_outgoing=True)
    line.heard(SerialFrame(7, reply[1:-2], reply, Direction.REPLY, 1.0, 1.1), at=5.0)
    assert packets(file) == [
        (line_pdu("mbrtu", MASTER, unit(7), request), ""),
        (line_pdu("mbrtu", unit(7), MASTER, reply), ""),
    ]


def test_an_ascii_frame_is_written_in_its_rtu_form_with_its_characters_in_the_comment() -> None:
    file = io.BytesIO()
    pdu = b"\x03\x00\x6b\x00\x03"
    frame = SerialFrame(7, pdu, encode_ascii(7, pdu), Direction.REQUEST, 0.0, 0.1)
    Capture(file).line("ascii:///dev/ttyS0").heard(frame)
    assert packets(file) == [
        (line_pdu("mbrtu", MASTER, unit(7), encode_rtu(7, pdu)), "ASCII frame :0703006B000388"),
    ]


@pytest.mark.parametrize(
    ("number", "pdu", "words"),
    [
        (7, b"\x07", "unit 7: 7 (read exception status), request"),
        (0, b"\x06\x00\x01\x00\x03", "unit 0: 6 (write single register), request"),
    ],
)
def test_what_the_dissector_of_wireshark_refuses_is_put_in_words(number: int, pdu: bytes, words: str) -> None:
    file = io.BytesIO()
    raw = encode_rtu(number, pdu)
    Capture(file).line("x").heard(SerialFrame(number, pdu, raw, Direction.REQUEST, 0.0, 0.1))
    ((data, comment),) = packets(file)
    assert comment.startswith(words)
    assert data == line_pdu("data", MASTER, unit(number), raw, info=comment)


def test_damaged_bytes_are_kept_with_the_reason() -> None:
    file = io.BytesIO()
    Capture(file).line("x").heard(Damaged(b"\x01\x02", Damage.TOO_SHORT, 2, 0.0, 0.1))
    ((data, comment),) = packets(file)
    assert data.endswith(bytes(4) + b"\x01\x02")
    assert comment == "2 damaged bytes: too few bytes for a frame"


def test_a_line_has_one_interface_however_often_it_is_asked_for() -> None:
    file = io.BytesIO()
    capture = Capture(file)
    for _ in range(2):
        capture.line("rtu:///dev/ttyS0").heard(Damaged(b"", Damage.CHARACTER, 0, 0.0, 0.0))
    capture.line("rtu:///dev/ttyS1")
    assert [kind for kind, _ in blocks(file.getvalue())].count(1) == 2


class MeetingLock:
    """A lock that each of two threads leaves for the first time only when the other one has had it too."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._meeting = threading.Barrier(2, timeout=60)
        self._met: set[int] = set()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()
        if threading.get_ident() not in self._met:
            self._met.add(threading.get_ident())
            self._meeting.wait()


def test_a_line_that_two_threads_ask_for_at_once_has_one_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    lock, file = MeetingLock(), io.BytesIO()
    with monkeypatch.context() as patched:
        patched.setattr("busway.observe.capture.threading.Lock", lambda: lock)
        capture = Capture(file)
    threads = [threading.Thread(target=capture.line, args=("rtu:///dev/ttyS0",)) for _ in range(2)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert [kind for kind, _ in blocks(file.getvalue())].count(1) == 1


def test_a_full_disk_ends_the_file_and_nothing_else(caplog: pytest.LogCaptureFixture) -> None:
    class Full(io.BytesIO):
        full = False

        def write(self, data: object) -> int:
            if self.full:
                raise OSError(28, "No space left on device")
            return super().write(data)  # type: ignore[arg-type]

    file = Full()
    capture = Capture(file)
    stream = capture.stream(HERE, PEER)
    stream.sent(ADU)
    file.full = True
    with caplog.at_level(logging.WARNING, "busway.capture"):
        stream.sent(ADU)
        stream.sent(ADU)
    assert capture.failure == "No space left on device"
    assert capture.packets == 1
    assert len(caplog.records) == 1


def test_what_comes_after_the_end_is_not_written(tmp_path: Path) -> None:
    file = tmp_path / "capture.pcapng"
    with Capture(file.open("wb")) as capture:
        stream = capture.stream(HERE, PEER)
        stream.sent(ADU)
    stream.sent(ADU)
    capture.close()
    assert len(packets(io.BytesIO(file.read_bytes()))) == 1
