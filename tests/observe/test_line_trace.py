"""Traffic of lines as log lines."""

import logging
from collections.abc import Iterator

import pytest

from busway.framing.ascii import encode_ascii
from busway.framing.rtu import encode_rtu
from busway.observe.line_trace import LineTrace, trace_for
from busway.observe.trace import TRACE, StreamTrace, TraceLevel

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
    assert isinstance(trace_for("mbap", "x", is_server=True), StreamTrace)
    assert isinstance(trace_for("rtu", "x", is_server=True), LineTrace)
