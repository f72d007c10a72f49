"""Serving on a real port (a pseudo-terminal on a paced line)."""

import asyncio
import contextlib
import os
import tty
from collections.abc import Iterator

import pytest
from waiting import until
from whole_frames import line_of_whole_frames

import busway
from busway.framing.ascii import encode_ascii
from busway.framing.rtu import encode_rtu
from busway.options.ports import SerialSettings
from busway.pdu.functions import STANDARD, AnyRequest
from busway.pdu.message import Message
from busway.pdu.read_items import ReadHoldingRegisters
from busway.server.status_indicators import StatusIndicator
from busway.server.tcp import settle
from busway.session.responder import RequestContext, ResponderAnswer, ServedUnit
from busway.testing.line import PacedLine
from busway.transport.serial.blocking import BlockingSerialPort

BAUD = 115_200
READ = encode_rtu(5, ReadHoldingRegisters(0, 2).encode())


@pytest.fixture
def line() -> Iterator[PacedLine]:
    with line_of_whole_frames(ports=2, baud=BAUD) as made:
        yield made


def url(line: PacedLine, options: str = "", framing: str = "rtu") -> str:
    return f"{framing}://{line.paths[1]}?baud={BAUD}{options}"


async def until_spoken(line: PacedLine, count: int = 1) -> None:
    """Wait until the server has sent so many frames, the last of them whole."""
    await until(lambda: len(spoken(line)) == count)
    await asyncio.to_thread(line.wait_quiet)


def spoken(line: PacedLine) -> list[bytes]:
    """What the server has said; on a busy machine a frame may stall in its middle."""
    return [talk.data for talk in line.transmissions(0.05) if talk.port == 1]


@pytest.mark.clause("S11")
@pytest.mark.clause("S16")
@pytest.mark.real_time
async def test_server_counts_what_passes_and_speaks_for_its_own_units_alone(line: PacedLine) -> None:
    async with busway.serve(url(line), units={5: busway.Device(holding_registers=4)}) as server:
        for frame in (
            encode_rtu(6, b"\x03\x00\x00\x00\x02"),
            encode_rtu(6, b"\x03\x04\x00\x00\x00\x00"),
            encode_rtu(0, b"\x06\x00\x00\x00\x09"),
            READ[:-1] + b"\x00",
            READ,
        ):
            line.inject(frame)
            await asyncio.to_thread(line.wait_quiet, 0.02)
        await until_spoken(line)
        assert spoken(line) == [encode_rtu(5, b"\x03\x04\x00\x09\x00\x00")]
        (status,) = server.status().listeners
        assert status.endpoint == server.endpoints[0] == f"rtu://{line.paths[1]}"
        assert (status.requests, status.foreign, status.damaged) == (2, 2, 1)
        assert (status.counters.bus_message_count, status.counters.bus_communication_error_count) == (4, 1)
        assert status.counters.server_no_response_count == 1
        assert status.indicators.error is StatusIndicator.FLASHING
        assert status.indicators.device_status is StatusIndicator.ON
        assert server.status().counters.requests == 2


@pytest.mark.clause("S17")
@pytest.mark.real_time
async def test_diagnostics_that_change_the_line_are_offered_there_and_not_over_a_network(line: PacedLine) -> None:
    units = {5: busway.Device(holding_registers=4)}
    async with busway.serve(url(line), "rtu+tcp://127.0.0.1:0", "udp://127.0.0.1:0", units=units) as server:
        async with busway.open(f"rtu://{line.paths[0]}?baud={BAUD}") as link:
            assert await link.unit(5).diagnostics(0x0A) == b"\x00\x00"
        for endpoint in server.endpoints[1:]:
            async with busway.open(endpoint) as link:
                with pytest.raises(busway.ExceptionReply, match="01"):
                    await link.unit(5).diagnostics(0x0A)
    async with (
        busway.serve(url(line), units=units, diagnostics_changes=False),
        busway.open(f"rtu://{line.paths[0]}?baud={BAUD}") as link,
    ):
        with pytest.raises(busway.ExceptionReply, match="01"):
            await link.unit(5).diagnostics(0x0A)


@pytest.mark.clause("S17")
@pytest.mark.clause("S19")
@pytest.mark.real_time
async def test_listen_only_mode_shows_in_the_status_and_ends_with_a_restart(line: PacedLine) -> None:
    async with (
        busway.serve(url(line), units={5: busway.Device(holding_registers=4)}) as server,
        busway.open(f"rtu://{line.paths[0]}?baud={BAUD}&timeout=0.3&retries=0&open_after=0") as link,
    ):
        with pytest.raises(busway.WriteOutcomeUnknown):
            await link.unit(5).diagnostics(4)
        (status,) = server.status().listeners
        assert status.listen_only
        assert status.indicators.device_status is StatusIndicator.FLASHING
        with pytest.raises(busway.WriteOutcomeUnknown):
            await link.unit(5).diagnostics(1)
        assert await link.unit(5).read_holding_registers(0, count=1, timeout=5.0) == [0]


@pytest.mark.clause("S1")
@pytest.mark.clause("S16")
@pytest.mark.real_time
async def test_two_requests_back_to_back_on_a_real_line_are_executed_and_the_last_is_answered(line: PacedLine) -> None:
    device = busway.Device(holding_registers=4)
    async with busway.serve(url(line), units={5: device}) as server:
        last = encode_rtu(5, b"\x06\x00\x01\x00\x08")
        line.inject(encode_rtu(5, b"\x06\x00\x00\x00\x09") + last)
        await until_spoken(line)
        await asyncio.to_thread(line.wait_quiet, 0.02)
        assert device.holding_registers[:2] == [9, 8]
        assert spoken(line) == [last]
        (status,) = server.status().listeners
        assert (status.requests, status.abandoned, status.event_count) == (2, 1, 1)
        assert status.counters.server_no_response_count == 1


@pytest.mark.clause("S16")
@pytest.mark.clause("S17")
@pytest.mark.real_time
async def test_units_of_a_port_have_counters_and_modes_of_their_own_and_the_status_their_sums(line: PacedLine) -> None:
    units = {1: busway.Device(holding_registers=4), 3: busway.Device(holding_registers=4)}
    async with (
        busway.serve(url(line), units=units) as server,
        busway.open(f"rtu://{line.paths[0]}?baud={BAUD}&timeout=5&retries=0&open_after=0") as link,
    ):
        await link.unit(3).read_holding_registers(0, count=1)
        while not server.status().listeners[0].listen_only:
            line.inject(encode_rtu(3, b"\x08\x00\x04\x00\x00"))
            await asyncio.to_thread(line.wait_quiet, 0.02)
        assert await link.unit(1).read_holding_registers(0, count=1) == [0]
        assert await link.unit(1).diagnostics(0x0E) == b"\x00\x02"
        (status,) = server.status().listeners
        assert (status.listen_only, status.listen_only_units) == (True, (3,))
        assert (status.counters.bus_message_count, status.counters.server_message_count) == (4, 4)
        while status.listen_only:  # on a busy machine a frame may stall in its middle: then it is damaged
            line.inject(encode_rtu(3, b"\x08\x00\x01\x00\x00"))
            await asyncio.to_thread(line.wait_quiet, 0.02)
            (status,) = server.status().listeners
        of_three = int.from_bytes(await link.unit(3).diagnostics(0x0B), "big")
        (status,) = server.status().listeners
        assert (status.listen_only, status.counters.bus_message_count) == (False, of_three + 5)
        of_one = int.from_bytes(await link.unit(1).diagnostics(0x0B), "big")
        assert of_one > of_three + 5


@pytest.mark.clause("S12")
@pytest.mark.real_time
async def test_delimiter_is_changed_over_a_real_line() -> None:
    with line_of_whole_frames(ports=2, baud=BAUD, data_bits=7) as line:
        units = {5: busway.Device(holding_registers=4)}
        async with busway.serve(url(line, framing="ascii"), units=units):
            async with busway.open(f"ascii://{line.paths[0]}?baud={BAUD}") as link:
                assert await link.unit(5).diagnostics(3, b"?\x00") == b"?\x00"
            async with busway.open(f"ascii://{line.paths[0]}?baud={BAUD}&delimiter=63") as link:
                assert await link.unit(5).read_holding_registers(0, count=1) == [0]


class Slow:
    """Answers when it is told to."""

    functions = STANDARD
    generation = 0

    def __init__(self) -> None:
        self.asked = asyncio.Event()
        self.go_on = asyncio.Event()

    def serves(self, unit: int) -> ServedUnit | None:
        return ServedUnit(unit) if unit == 5 else None

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        return self._answer(request)

    async def _answer(self, request: AnyRequest) -> Message:
        self.asked.set()
        await self.go_on.wait()
        if isinstance(request, ReadHoldingRegisters) and request.address:
            raise RuntimeError("broken")
        return ReadHoldingRegisters.Reply(bytes(4))


@pytest.mark.clause("T38")
@pytest.mark.real_time
async def test_server_that_takes_no_more_still_answers_what_it_was_asked_and_nothing_else(line: PacedLine) -> None:
    handler = Slow()
    async with busway.serve(url(line), responder=handler) as server:  # type: ignore[arg-type]
        line.inject(READ)
        await handler.asked.wait()
        await server.take_no_more()
        handler.go_on.set()
        await until_spoken(line)
        (status,) = server.status().listeners
        while not status.foreign:  # on a busy machine a frame may stall in its middle: then it is damaged
            line.inject(READ)
            await asyncio.to_thread(line.wait_quiet, 0.02)
            (status,) = server.status().listeners
        assert server.status().counters.requests == 1
    assert len(spoken(line)) == 1


@pytest.mark.real_time
async def test_answer_that_waits_for_its_silence_leaves_before_the_port_is_closed() -> None:
    with PacedLine(ports=2, baud=1200) as slow:  # a silence of 32 ms
        handler = Slow()
        handler.go_on.set()
        server = busway.serve(f"rtu://{slow.paths[1]}?baud=1200", responder=handler)  # type: ignore[arg-type]
        await server.start()
        while not handler.asked.is_set():  # on a busy machine a frame may stall in its middle, and is none then
            slow.inject(READ)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(handler.asked.wait(), 2)
        await settle()  # the answer is there, and waits
        await server.stop()
        await until(lambda: any(talk.port == 1 for talk in slow.transmissions(0.01)))


@pytest.mark.real_time
async def test_requests_that_come_while_the_server_stops_are_neither_executed_nor_missing_in_the_count(
    line: PacedLine,
) -> None:
    class EndsSlowly(Slow):
        async def _answer(self, request: AnyRequest) -> Message:
            self.asked.set()
            try:
                await asyncio.Event().wait()
            finally:
                ending.set()
                await self.go_on.wait()
            raise AssertionError("it is cancelled")

    ending, handler = asyncio.Event(), EndsSlowly()
    server = busway.serve(url(line), responder=handler)  # type: ignore[arg-type]
    await server.start()
    line.inject(READ)
    await handler.asked.wait()
    handler.asked.clear()
    stopping = asyncio.create_task(server.stop())
    await ending.wait()  # the port is open until the handler has ended
    line.inject(READ)
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(handler.asked.wait(), 0.1)
    handler.go_on.set()
    await stopping
    assert server.status().counters.requests == 1


@pytest.mark.clause("S6")
@pytest.mark.real_time
async def test_slow_handler_answers_late_and_not_when_another_station_has_sent(line: PacedLine) -> None:
    handler = Slow()
    async with busway.serve(url(line), responder=handler) as server:  # type: ignore[arg-type]
        line.inject(READ)
        await handler.asked.wait()
        handler.go_on.set()
        await until_spoken(line)
        handler.go_on.clear()
        handler.asked.clear()
        line.inject(READ)
        await handler.asked.wait()
        line.inject(encode_rtu(6, b"\x03\x00\x00\x00\x02"))
        await until(lambda: server.status().listeners[0].abandoned == 1)
        handler.go_on.set()
        await asyncio.to_thread(line.wait_quiet, 0.05)
        assert len(spoken(line)) == 1
        line.inject(READ)
        handler.asked.clear()
        handler.go_on.clear()
        await handler.asked.wait()  # left in work when the server stops
    assert len(spoken(line)) == 1


@pytest.mark.clause("S19")
@pytest.mark.real_time
async def test_handler_that_fails_shows_as_a_steady_error(line: PacedLine) -> None:
    class Broken(Slow):
        def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
            raise RuntimeError("broken")

    async with busway.serve(url(line), responder=Broken()) as server:  # type: ignore[arg-type]
        line.inject(READ)
        await until_spoken(line)
        assert spoken(line) == [encode_rtu(5, b"\x83\x04")]
        assert server.status().listeners[0].indicators.error is StatusIndicator.ON
        assert server.status().counters.responder_failures == 1


@pytest.mark.clause("S15")
@pytest.mark.real_time
async def test_taken_port_is_an_error_that_names_the_holder_and_an_absent_one_is_waited_for(line: PacedLine) -> None:
    units = {5: busway.Device(holding_registers=4)}
    with BlockingSerialPort(line.paths[1], SerialSettings(baud=BAUD)):
        server = busway.serve(url(line), "tcp://127.0.0.1:0", units=units)
        with pytest.raises(busway.LinkDown, match="held by"):
            await server.start()
        assert not server.is_running
    line.unplug(1)
    async with busway.serve(url(line, "&reopen_first=0.01&reopen_most=0.05"), units=units) as server:
        assert not server.status().listeners[0].is_open
        line.replug(1)
        await until(lambda: server.status().listeners[0].is_open)
        line.inject(READ)
        await until_spoken(line)


@pytest.mark.real_time
async def test_server_can_be_stopped_and_started_again(line: PacedLine) -> None:
    server = busway.serve(url(line), units={5: busway.Device(holding_registers=4)})
    for number in range(3):
        async with server:
            line.inject(READ)
            await until_spoken(line, number + 1)
    await server.reset()
    assert server.status().counters.requests == 0
    await server.stop()
    assert server.endpoints == []


@pytest.mark.clause("S3")
def test_line_needs_units_of_its_own_and_a_handler_that_says_which() -> None:
    with pytest.raises(busway.ConfigError, match="1…247"):
        busway.serve("rtu:///dev/ttyUSB0", units={0: busway.Device(), 255: busway.Device()})

    class Unsaid:
        functions = STANDARD
        generation = 0

        def serves(self, unit: int) -> ServedUnit | None:
            return None

    with pytest.raises(busway.ConfigError, match="1…247"):
        busway.serve("rtu:///dev/ttyUSB0", responder=Unsaid())  # type: ignore[arg-type]


@pytest.mark.clause("S18")
@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("rtu:///dev/ttyUSB0?port_wait=1", "unknown option of a listener"),
        ("rtu:///dev/ttyUSB0?parity=mark", "parity"),
        ("ascii:///dev/ttyUSB0?gap_limit=1", "unknown option"),
        ("rtu+tcp://127.0.0.1:0?strict_timing=on", "unknown option"),
        ("udp://127.0.0.1:0?baud=9600", "there are none"),
    ],
)
def test_wrong_option_of_a_listener_is_one_clear_error(endpoint: str, words: str) -> None:
    with pytest.raises(busway.ConfigError, match=words):
        busway.serve(endpoint, units={5: busway.Device(holding_registers=4)})


@pytest.mark.clause("S15")
@pytest.mark.parametrize("framing", ["rtu", "ascii"])
@pytest.mark.real_time
async def test_server_whose_port_hears_itself_executes_each_write_once_and_says_so(
    framing: str, caplog: pytest.LogCaptureFixture
) -> None:
    device = busway.Device(holding_registers=4)
    written: list[object] = []
    device.on_write("holding_registers")(written.append)
    with PacedLine(ports=2, baud=BAUD, echo=[1]) as line:
        async with (
            busway.serve(url(line, framing=framing), units={5: device}) as server,
            busway.open(f"{framing}://{line.paths[0]}?baud={BAUD}") as link,
        ):
            assert await link.unit(5).read_holding_registers(0, count=2) == [0, 0]
            for _ in range(3):
                await link.unit(5).write_single_register(0, 9)
            await asyncio.to_thread(line.wait_quiet, 0.1)
            (status,) = server.status().listeners
    assert len(written) == 3
    assert (status.requests, status.echoes, status.foreign, status.damaged) == (4, 4, 0, 0)
    assert [one.getMessage() for one in caplog.records if "echo" in one.getMessage()] == [
        f"{status.endpoint}: the port receives what it sends; set echo=on"
    ]


@pytest.mark.parametrize("framing", ["rtu", "ascii"])
async def test_write_repeated_at_once_over_a_pseudo_terminal_without_line_times_is_executed_each_time(
    framing: str,
) -> None:
    encode = encode_rtu if framing == "rtu" else encode_ascii
    frame = encode(5, b"\x06\x00\x00\x00\x09")
    device = busway.Device(holding_registers=4)
    near, far = os.openpty()
    try:
        tty.setraw(far)
        os.set_blocking(near, False)
        async with busway.serve(f"{framing}://{os.ttyname(far)}?baud=1200", units={5: device}) as server:
            for _ in range(5):
                os.write(near, frame)
                answer = b""
                async with asyncio.timeout(5):
                    while len(answer) < len(frame):
                        with contextlib.suppress(BlockingIOError):
                            answer += os.read(near, 256)
                        await asyncio.sleep(0.001)
                assert answer == frame
            (status,) = server.status().listeners
            assert (status.requests, status.echoes) == (5, 0)
    finally:
        os.close(near)
        os.close(far)
