"""The tail of the traffic: what is kept, how it is described, and what it leaves alone."""

import io

import pytest

from busway.apps.web.simulation_traffic import Traffic
from busway.errors import ConfigError
from busway.framing.ascii import encode_ascii
from busway.framing.mbap import encode_mbap
from busway.framing.received import Damage, Damaged, Direction, SerialFrame
from busway.framing.rtu import encode_rtu
from busway.observe.capture import Capture
from busway.observe.connection_trace import trace_for
from busway.observe.socket_addresses import SocketAddresses
from busway.observe.trace import TRACE

ENDS = SocketAddresses(("127.0.0.1", 5020), ("10.0.0.7", 40_000))
READ = bytes.fromhex("03 00 00 00 02")
REPLY = bytes.fromhex("03 04 00 01 00 02")
REFUSED = bytes.fromhex("83 02")
LINE_ADUS = {"rtu": encode_rtu(1, READ), "ascii": encode_ascii(1, READ)}


class Ticking:
    """A clock that is a quarter of a second later whenever it is asked."""

    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        self.now += 0.25
        return self.now


@pytest.fixture
def traffic():
    tail = Traffic(lambda: {5020}, kept=4, clock=Ticking())
    tail.start()
    yield tail
    tail.stop()


def test_a_request_and_its_reply_are_described_together(traffic):
    connection = traffic.connection(ENDS)
    connection.received(encode_mbap(7, 1, READ))
    connection.sent(encode_mbap(7, 1, REPLY))
    request, reply = (traffic.shown(one) for one in traffic.after(0, 10))
    assert (request.direction, request.unit, request.transaction, request.function) == ("request", 1, 7, 3)
    assert request.peer == "10.0.0.7:40000"
    assert request.raw == "03 00 00 00 02"
    assert "holding register 4x1" in request.text
    assert reply.direction == "reply"
    assert reply.seconds == 0.25
    assert not reply.exception


def test_an_exception_is_marked_as_one(traffic):
    connection = traffic.connection(ENDS)
    connection.sent(encode_mbap(7, 1, REFUSED))
    (reply,) = (traffic.shown(one) for one in traffic.after(0, 10))
    assert reply.exception
    assert "illegal data address" in reply.text


def test_frames_that_come_in_pieces_or_together_are_frames(traffic):
    connection = traffic.connection(ENDS)
    data = encode_mbap(1, 1, READ) + encode_mbap(2, 1, READ)
    connection.received(data[:5])
    connection.received(data[5:15])
    connection.received(data[15:])
    assert [one.transaction for one in traffic.after(0, 10)] == [1, 2]


def test_bytes_that_are_no_frame_are_shown_as_damaged(traffic):
    connection = traffic.connection(ENDS)
    connection.sent(bytes.fromhex("00 01 00 00 00 00 01 03"))  # a length outside of the limits
    connection.sent(encode_mbap(1, 1, REPLY))
    broken, after = (traffic.shown(one) for one in traffic.after(0, 10))
    assert broken.direction == "damaged"
    assert "length field 0" in broken.text
    assert after.direction == "damaged"


def test_only_so_many_frames_are_kept_and_the_numbers_go_on(traffic):
    connection = traffic.connection(ENDS)
    for transaction in range(6):
        connection.received(encode_mbap(transaction, 1, READ))
    assert (traffic.first, traffic.last) == (3, 6)
    assert [one.number for one in traffic.after(0, 10)] == [3, 4, 5, 6]
    assert [one.number for one in traffic.after(4, 10)] == [5, 6]
    assert [one.number for one in traffic.after(0, 2)] == [5, 6]
    assert traffic.after(6, 10) == []


def test_a_frame_is_described_once(traffic):
    traffic.connection(ENDS).received(encode_mbap(1, 1, READ))
    (frame,) = traffic.after(0, 1)
    assert traffic.shown(frame) is traffic.shown(frame)


def test_connections_that_the_program_made_itself_are_left_out(traffic):
    traffic.connection(SocketAddresses(("127.0.0.1", 51_111), ("10.0.0.9", 502))).sent(encode_mbap(1, 1, READ))
    traffic.connection(SocketAddresses()).received(encode_mbap(1, 1, READ))
    assert traffic.last == 0


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
def test_lines_of_client_links_of_the_program_are_left_out(traffic, framing):
    trace_for(framing, f"{framing}+tcp://10.0.0.9", is_server=False).sent(LINE_ADUS[framing])
    assert traffic.last == 0
    trace_for(framing, f"{framing}+tcp://10.0.0.9", is_server=True).sent(LINE_ADUS[framing])
    assert traffic.last == 1


def test_a_reply_on_a_line_is_paired_by_its_unit_and_what_leaves_is_a_reply(traffic):
    line = traffic.line("rtu:///dev/ttyS1")
    write = bytes.fromhex("06 00 00 00 05")
    frame = SerialFrame(unit=3, pdu=write, raw=b"", direction=Direction.UNKNOWN, began=0.0, ended=0.0)
    line.heard(frame, at=10.0)
    line.heard(frame, at=10.5, is_outgoing=True)
    request, reply = (traffic.shown(one) for one in traffic.after(0, 10))
    assert (request.direction, reply.direction) == ("request", "reply")
    assert reply.seconds == 0.5


def test_damaged_bytes_of_a_line_say_why(traffic):
    line = traffic.line("rtu:///dev/ttyS1")
    line.heard(Damaged(raw=b"\x01\x03", reason=Damage.TOO_SHORT, began=0.0, ended=0.0, size=2))
    (damaged,) = (traffic.shown(one) for one in traffic.after(0, 10))
    assert damaged.direction == "damaged"
    assert Damage.TOO_SHORT.value in damaged.text


def test_a_capture_file_that_is_open_gets_everything_too():
    stream = io.BytesIO()
    capture = Capture(stream)
    TRACE.capture_into(capture)
    try:
        traffic = Traffic(lambda: {5020})
        traffic.start()
        traffic.connection(ENDS).received(encode_mbap(1, 1, READ))
        traffic.connection(SocketAddresses(("127.0.0.1", 1), ("10.0.0.9", 502))).sent(encode_mbap(1, 1, READ))
        traffic.stop()
        assert TRACE.capture is capture
        assert capture.packets == 2
        assert traffic.last == 1
    finally:
        TRACE.capture_into(None)


def test_recording_ends_where_it_began(traffic):
    assert TRACE.capture is traffic
    with pytest.raises(ConfigError):
        traffic.start()
    traffic.stop()
    assert TRACE.capture is None
    assert not TRACE.level


def test_one_that_stops_below_another_leaves_nothing_behind_either():
    below, above = Traffic(lambda: {5020}), Traffic(lambda: {5020})
    below.start()
    above.start()
    below.stop()
    connection = above.connection(ENDS)
    connection.received(encode_mbap(1, 1, READ))
    assert (below.last, above.last) == (0, 1)
    above.stop()
    assert TRACE.capture is None


def test_frames_that_other_threads_record_while_others_are_read_are_shown_next_time(traffic):
    class Meanwhile(int):
        """A number that records a frame when it is compared."""

        def __ge__(self, other):
            traffic.add("10.0.0.8:40000", READ, is_reply=False)
            return super().__ge__(other)

    for _ in range(3):
        traffic.add("10.0.0.7:40000", READ, is_reply=False)
    assert [one.number for one in traffic.after(Meanwhile(0), 10)] == [1, 2, 3]
    assert [one.number for one in traffic.after(3, 10)] == [4, 5, 6]


def test_the_numbers_of_frames_are_in_order_whichever_thread_records_them():
    def clock():
        if traffic.last == 0 and not others:
            others.append(traffic.add("rtu:///dev/ttyS1", READ, is_reply=False, at=1000.0))
        return 1000.0

    others = []
    traffic = Traffic(clock=clock)
    traffic.add("rtu:///dev/ttyS0", READ, is_reply=False)
    assert [one.number for one in traffic.after(0, 10)] == [1, 2]
    assert [one.number for one in traffic.after(1, 10)] == [2]


def test_a_watcher_is_called_until_it_is_removed(traffic):
    told = []
    unwatch = traffic.watch(lambda: told.append(traffic.last))
    connection = traffic.connection(ENDS)
    connection.received(encode_mbap(1, 1, READ))
    unwatch()
    connection.received(encode_mbap(2, 1, READ))
    assert told == [1]
