"""Traffic of lines as log lines."""

import io
import logging
from collections.abc import Callable, Iterator

import pytest
from capture_file import blocks
from waiting import until

from busway.framing.ascii import encode_ascii
from busway.framing.received import Damaged, Direction, FrameOrDamage, SerialFrame
from busway.framing.rtu import encode_rtu
from busway.observe.capture import Capture
from busway.observe.connection_trace import trace_for
from busway.observe.line_trace import LineTrace
from busway.observe.mbap_trace import MbapTrace
from busway.observe.trace import TRACE, TraceLevel

REQUEST = bytes.fromhex("03 00 00 00 02")
REPLY = bytes.fromhex("03 04 00 01 00 02")


@pytest.fixture(params=[one for one in TraceLevel if one > 0])
def level(request: pytest.FixtureRequest) -> Iterator[TraceLevel]:
    TRACE.set(request.param)
    yield request.param
    TRACE.set(TraceLevel.OFF)


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
def test_both_directions_are_shown_as_much_as_the_level_says(
    framing: str, level: TraceLevel, caplog: pytest.LogCaptureFixture
) -> None:
    encode = encode_rtu if framing == "rtu" else encode_ascii
    trace = LineTrace(framing, "the line")
    with caplog.at_level(logging.DEBUG, "busway.trace"):
        trace.sent(encode(5, REQUEST))
        trace.received(encode(5, REPLY))
    text = "\n".join(record.getMessage() for record in caplog.records)
    assert "the line > 5 ReadHoldingRegisters(address=0, count=2)" in text
    assert "the line < 5 " in text
    assert ("unit 5:" in text) is (level >= TraceLevel.FRAME)
    assert ("bytes:" in text) is (level >= TraceLevel.BYTES)


def test_damaged_chunks_are_shown(caplog: pytest.LogCaptureFixture) -> None:
    TRACE.set(TraceLevel.MESSAGE)
    try:
        with caplog.at_level(logging.DEBUG, "busway.trace"):
            trace = LineTrace("ascii", "the line")
            trace.received(b":zz\r\n")
    finally:
        TRACE.set(TraceLevel.OFF)
    assert "damaged" in caplog.text


def test_stream_of_tcp_has_its_own() -> None:
    assert isinstance(trace_for("mbap", "x", is_server=True), MbapTrace)
    assert isinstance(trace_for("rtu", "x", is_server=True), LineTrace)


UNKNOWN = bytes.fromhex("64 01 02 03")
"""A request of a function whose length is not known."""


class Recorded:
    """Keeps what is heard on a line."""

    def __init__(self) -> None:
        self.heard_frames: list[tuple[bool, FrameOrDamage]] = []

    def line(self, name: str, *, is_server: bool = True) -> "Recorded":
        return self

    def heard(self, found: FrameOrDamage, *, at: float | None = None, is_outgoing: bool = False) -> None:
        self.heard_frames.append((is_outgoing, found))

    @property
    def pdus(self) -> list[tuple[str, bytes]]:
        return [
            (">" if is_outgoing else "<", found.pdu if isinstance(found, SerialFrame) else b"damaged")
            for is_outgoing, found in self.heard_frames
        ]


class FakeTime:
    """A clock that stands, and timers that call when it is moved past them."""

    def __init__(self) -> None:
        self.now = 100.0
        self.set: list[FakeTimer] = []

    def __call__(self) -> float:
        return self.now

    def timer(self, delay: float, call: Callable[[], None]) -> "FakeTimer":
        timer = FakeTimer(self, self.now + delay, call)
        self.set.append(timer)
        return timer

    def advance(self, seconds: float) -> None:
        self.now += seconds
        for timer in [one for one in self.set if one.due <= self.now]:
            self.set.remove(timer)
            timer.call()


class FakeTimer:
    def __init__(self, time: FakeTime, due: float, call: Callable[[], None]) -> None:
        self.time, self.due, self.call = time, due, call

    def start(self) -> None:
        pass

    def cancel(self) -> None:
        if self in self.time.set:
            self.time.set.remove(self)


@pytest.fixture
def recorded() -> Iterator[Recorded]:
    """What the process captures into for the time of a test."""
    recorded = Recorded()
    TRACE.capture_into(recorded)  # type: ignore[arg-type]  # of a recorder, the part for lines
    yield recorded
    TRACE.capture_into(None)
    assert not TRACE.undecided


@pytest.mark.parametrize("is_server", [False, True])
def test_a_frame_of_unknown_length_is_recorded_when_the_other_side_begins(recorded: Recorded, is_server: bool) -> None:
    clock = FakeTime()
    trace = LineTrace("rtu", "x", is_server=is_server, clock=clock, make_timer=clock.timer)
    ours, theirs = (trace.received, trace.sent) if is_server else (trace.sent, trace.received)
    for _ in range(3):  # the clock stands: no silence between them
        ours(encode_rtu(1, UNKNOWN))
        theirs(encode_rtu(1, b"\xe4\x01"))
        ours(encode_rtu(1, REQUEST))
        theirs(encode_rtu(1, REPLY))
    TRACE.settle()
    there, back = ("<", ">") if is_server else (">", "<")
    assert recorded.pdus == [(there, UNKNOWN), (back, b"\xe4\x01"), (there, REQUEST), (back, REPLY)] * 3
    sent = [
        found.direction
        for is_outgoing, found in recorded.heard_frames
        if is_outgoing and not isinstance(found, Damaged)
    ]
    assert set(sent) == {Direction.REPLY if is_server else Direction.REQUEST}


@pytest.mark.parametrize("piece", [encode_rtu(1, UNKNOWN), encode_rtu(1, REQUEST)[:-1], b"\x01", b"noise"])
def test_silence_ends_what_was_received(recorded: Recorded, piece: bytes) -> None:
    clock = FakeTime()
    trace = LineTrace("rtu", "x", is_server=True, clock=clock, make_timer=clock.timer)
    trace.received(piece)
    assert recorded.pdus == []
    for _ in range(10):
        clock.advance(0.02)
    assert len(recorded.pdus) == 1
    assert not clock.set
    assert not TRACE.undecided


def test_a_frame_in_two_pieces_is_one_frame(recorded: Recorded) -> None:
    clock = FakeTime()
    trace = LineTrace("rtu", "x", is_server=True, clock=clock, make_timer=clock.timer)
    frame = encode_rtu(1, REQUEST)
    trace.received(frame[:3])
    clock.advance(0.03)
    trace.received(frame[3:])
    assert recorded.pdus == [("<", REQUEST)]
    clock.advance(1.0)
    assert not clock.set


def test_all_is_in_the_file_when_it_is_closed() -> None:
    file = io.BytesIO()
    capture = Capture(file)
    TRACE.capture_into(capture)
    try:
        clock = FakeTime()
        trace = LineTrace("rtu", "x", is_server=True, clock=clock, make_timer=clock.timer)
        trace.received(encode_rtu(1, UNKNOWN))
        assert capture.packets == 0
        capture.close()
        assert capture.packets == 1
    finally:
        TRACE.capture_into(None)


@pytest.mark.real_time
async def test_silence_ends_a_frame_without_a_call_of_tick() -> None:
    file = io.BytesIO()
    capture = Capture(file)
    TRACE.capture_into(capture)
    try:
        trace = LineTrace("rtu", "x", is_server=True)
        trace.received(encode_rtu(1, UNKNOWN))
        await until(lambda: capture.packets == 1)
    finally:
        TRACE.capture_into(None)
    assert [kind for kind, _ in blocks(file.getvalue())].count(6) == 1
