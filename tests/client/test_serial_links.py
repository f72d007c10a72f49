"""Links over real ports (pseudo-terminals on a paced line), asyncio and blocking alike."""

import asyncio
import itertools
import os
import threading
import time
from collections.abc import Iterator

import pytest
from handles import open_handles
from waiting import until

import busway
from busway.client.kept_serial_late_replies import KEPT
from busway.framing.rtu import encode_rtu
from busway.testing.line import PacedLine

BAUD = 115_200


@pytest.fixture
def line() -> Iterator[PacedLine]:
    with PacedLine(ports=3, baud=BAUD) as made:
        yield made


def url(line: PacedLine, port: int = 0, options: str = "") -> str:
    return f"rtu://{line.paths[port]}?baud={BAUD}{options}"


def device() -> busway.Device:
    made = busway.Device(holding_registers=100, coils=100)
    made.holding_registers[0:10] = list(range(10))
    return made


@pytest.mark.clause("S7")
@pytest.mark.clause("S12")
@pytest.mark.parametrize("framing", ["rtu", "ascii"])
@pytest.mark.alone
def test_blocking_link_and_server_talk_over_real_ports(framing: str) -> None:
    with PacedLine(ports=2, baud=BAUD, data_bits=8 if framing == "rtu" else 7) as line:
        at = f"{framing}://{line.paths[1]}?baud={BAUD}"
        with (
            busway.serve_in_thread(at, units={1: device(), 7: device()}),
            busway.connect(f"{framing}://{line.paths[0]}?baud={BAUD}") as link,
        ):
            unit = link.unit(7)
            assert unit.read_holding_registers(0, count=10) == list(range(10))
            unit.write_multiple_registers(20, [5, 6])
            assert unit.read("4x21", count=2) == [5, 6]
            assert unit.diagnostics(0, b"\x12\x34") == b"\x12\x34"
            assert link.unit(1).read_coils(0, count=3) == [False] * 3


@pytest.mark.clause("S7")
@pytest.mark.parametrize("options", ["", "&precise_timing=on", "&strict_timing=off&gap_limit=0.02", "&echo=automatic"])
@pytest.mark.alone
async def test_asynchronous_link_and_server_talk_over_real_ports(line: PacedLine, options: str) -> None:
    async with (
        busway.serve(url(line, 1, options.replace("&strict_timing=off&gap_limit=0.02", "")), units={1: device()}),
        busway.open(url(line, 0, options)) as link,
    ):
        values = await asyncio.gather(*(link.unit(1).read_holding_registers(n, count=2) for n in range(5)))
        assert values == [[n, n + 1] for n in range(5)]


@pytest.mark.clause("S15")
@pytest.mark.parametrize("echo", ["on", "automatic"])
@pytest.mark.alone
async def test_line_that_echoes(echo: str) -> None:
    with PacedLine(ports=2, baud=BAUD, echo=True) as line:
        async with (
            busway.serve(url(line, 1, f"&echo={echo}"), units={1: device()}) as server,
            busway.open(url(line, 0, f"&echo={echo}")) as link,
        ):
            for _ in range(3):
                await link.unit(1).write_single_register(50, 3)
                assert await link.unit(1).read_holding_registers(50, count=1) == [3]
            assert server.status().listeners[0].foreign == 0
            assert link.counters.foreign_replies == 0


@pytest.mark.clause("S15")
@pytest.mark.parametrize("is_blocking", [True, False])
@pytest.mark.alone
async def test_echo_that_one_link_has_seen_is_no_reply_to_a_write_of_the_next(is_blocking: bool) -> None:
    with PacedLine(ports=2, baud=BAUD, echo=True) as line:
        path = url(line, 0, "&timeout=0.3")
        async with busway.serve(url(line, 1, "&echo=on"), units={1: device()}), busway.open(path) as link:
            assert await link.unit(1).read_holding_registers(1, count=1) == [1]

        def write_blocking() -> None:
            with busway.connect(path) as link:
                link.unit(1).write_single_register(50, 3)

        async def write() -> None:
            async with busway.open(path) as link:
                await link.unit(1).write_single_register(50, 3)

        try:
            with pytest.raises(busway.WriteOutcomeUnknown):
                await (asyncio.to_thread(write_blocking) if is_blocking else write())
        finally:
            KEPT.clear()  # a later line may have the same path


@pytest.mark.clause("S8")
@pytest.mark.alone
async def test_frames_on_a_real_line_keep_t3_5(line: PacedLine) -> None:
    """Above 19 200 bit/s it is 1.75 ms. What the tap sees is late by what the pty takes, never early."""
    async with (
        busway.serve(url(line, 1, "&precise_timing=on"), units={1: device(), 2: device()}),
        busway.open(url(line, 0, "&precise_timing=on")) as link,
    ):
        for number in range(20):
            await link.unit(1 + number % 2).read_holding_registers(0, count=10)
    talks = line.transmissions(0.0009)
    assert len(talks) == 40
    gaps = [after.begin - before.end for before, after in itertools.pairwise(talks)]
    assert min(gaps) > 0.00165


@pytest.mark.clause("S2")
@pytest.mark.alone
async def test_broadcast_over_a_real_line(line: PacedLine) -> None:
    one, other = device(), device()
    async with (
        busway.serve(url(line, 1), units={1: one}),
        busway.serve(url(line, 2), units={2: other}),
        busway.open(url(line)) as link,
    ):
        begun = time.monotonic()
        await link.unit(0).write_single_register(5, 99)
        assert time.monotonic() - begun >= 0.1
        with pytest.raises(busway.InvalidRequest, match="nothing was sent"):
            await link.unit(0).read_holding_registers(0, count=1)
        assert one.holding_registers[5] == other.holding_registers[5] == 99
        assert link.counters.requests == 1


@pytest.mark.alone
def test_many_threads_share_a_line(line: PacedLine) -> None:
    results: list[list[int]] = []
    with busway.serve_in_thread(url(line, 1), units={1: device(), 2: device()}):

        def work(number: int) -> None:
            with busway.connect(url(line)) as link:
                for _ in range(5):
                    results.append(link.unit(1 + number % 2).read_holding_registers(number, count=2))

        threads = [threading.Thread(target=work, args=(number,)) for number in range(6)]
        for one in threads:
            one.start()
        for one in threads:
            one.join()
    assert sorted(results) == sorted([[n, n + 1] for n in range(6)] * 5)
    assert line.collisions == 0


@pytest.mark.alone
def test_what_came_while_no_call_waited_is_not_taken_for_an_answer(line: PacedLine) -> None:
    """A blocking link reads only while a call waits; what lies in the port's buffer is late, or another master's."""
    with (
        busway.serve_in_thread(url(line, 1), units={1: device()}),
        busway.connect(url(line)) as link,
    ):
        assert link.unit(1).read_holding_registers(0, count=2) == [0, 1]
        line.inject(encode_rtu(1, bytes.fromhex("03 04 11 11 22 22")))
        line.wait_quiet(0.01)
        assert link.unit(1).read_holding_registers(2, count=2) == [2, 3]
        assert link.counters.foreign_replies >= 1


# The port comes and goes.


@pytest.mark.clause("S15")
@pytest.mark.alone
async def test_hot_unplug_ends_requests_at_once_and_the_port_is_found_again(line: PacedLine) -> None:
    handles = open_handles()
    for _ in range(3):
        async with (
            busway.serve(url(line, 1, "&reopen_first=0.01&reopen_most=0.05"), units={1: device()}) as server,
            busway.open(url(line, 0, "&reopen_first=0.01&reopen_most=0.05&port_wait=0.2"), retries=0) as link,
        ):
            assert await link.unit(1).read_holding_registers(1, count=1) == [1]
            line.unplug(0)
            with pytest.raises(busway.LinkDown):
                await link.unit(1).read_holding_registers(1, count=1)
            line.replug(0)
            assert await answered(link) == [1]
            line.unplug(1)
            await until(lambda: not server.status().listeners[0].is_open)
            assert server.status().listeners[0].indicators.error.value == "flashing"
            line.replug(1)
            await until(lambda: server.status().listeners[0].is_open)
            assert await answered(link) == [1]
    assert open_handles() == handles


async def answered(link: busway.AsyncLink) -> list[int]:
    """Ask until the port, or the unit, is back."""
    for _ in range(200):
        try:
            return await link.unit(1).read_holding_registers(1, count=1, timeout=0.2)
        except (busway.LinkDown, busway.NoReply):
            await asyncio.sleep(0.02)
    raise AssertionError("it did not come back")


@pytest.mark.clause("S15")
@pytest.mark.alone
def test_port_that_is_not_there_yet_is_waited_for(line: PacedLine) -> None:
    line.unplug(0)
    back = threading.Timer(0.1, lambda: line.replug(0))
    back.start()
    try:
        with (
            busway.serve_in_thread(url(line, 1), units={1: device()}),
            busway.connect(url(line, 0, "&port_wait=5&reopen_first=0.01&reopen_most=0.05")) as link,
        ):
            assert link.unit(1).read_holding_registers(1, count=1) == [1]
    finally:
        back.join()


@pytest.mark.clause("S15")
def test_port_that_does_not_come_is_one_clear_error_then_and_at_once_afterwards(tmp_path: object) -> None:
    with busway.connect(f"rtu://{tmp_path}/nothing?port_wait=0.05") as link:
        with pytest.raises(busway.LinkDown, match="it is not there"):
            link.unit(1).read_holding_registers(0, count=1)
        with pytest.raises(busway.LinkDown, match="next attempt"):
            link.unit(1).read_holding_registers(0, count=1)


def test_what_is_no_serial_port_is_one_clear_error() -> None:
    with (
        busway.connect("rtu:///dev/null?port_wait=5") as link,
        pytest.raises(busway.LinkDown, match="not a serial port"),
    ):
        link.unit(1).read_holding_registers(0, count=1)


# Who may use it.


@pytest.mark.clause("S15")
@pytest.mark.alone
async def test_one_port_has_one_user_in_a_process_and_links_of_one_loop_share_it(line: PacedLine) -> None:
    async with (
        busway.serve(url(line, 1), units={1: device()}),
        busway.open(url(line)) as one,
        busway.open(url(line)) as other,
    ):
        assert await one.unit(1).read_holding_registers(1, count=1) == [1]
        assert await other.unit(1).read_holding_registers(2, count=1) == [2]
        name = line.paths[0]
        for taken in (url(line), url(line).replace("rtu", "ascii", 1)):
            with pytest.raises(busway.ConfigError, match=f"{os.path.basename(name)}.*in use.*busway.open"):
                await asyncio.to_thread(busway.connect, taken)
        with pytest.raises(busway.ConfigError, match=r"in use.*busway.serve"):
            await asyncio.to_thread(busway.connect, url(line, 1))
        with pytest.raises(busway.ConfigError, match="in use"):
            await busway.serve(url(line), units={1: device()}).start()
    with busway.connect(url(line)):
        pass


@pytest.mark.alone
def test_two_loops_cannot_share_a_port(line: PacedLine) -> None:
    async def other() -> None:
        async with busway.open(url(line)):
            pass

    async def one() -> None:
        async with busway.open(url(line)):
            with pytest.raises(busway.ConfigError, match="in use"):
                await asyncio.to_thread(asyncio.run, other())

    asyncio.run(one())


# What can be asked for.


@pytest.mark.clause("S18")
@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("rtu:///dev/ttyUSB0?baud=49", "baud: must be 50"),
        ("rtu:///dev/ttyUSB0?baud=fast", "baud: must be a whole number"),
        ("rtu:///dev/ttyUSB0?parity=mark", "parity: must be one of even, odd, none"),
        ("rtu:///dev/ttyUSB0?data_bits=7", "data_bits: must be 8"),
        ("rtu:///dev/ttyUSB0?stop_bits=3", "stop_bits"),
        ("rtu:///dev/ttyUSB0?gap_limit=0.001&baud=9600", "gap_limit: must be t3.5"),
        ("rtu:///dev/ttyUSB0?strict_timing=on&gap_limit=1", "gap_limit: does not go with strict_timing"),
        ("rtu:///dev/ttyUSB0?character_timeout=1", "unknown option.*gap_limit"),
        ("rtu:///dev/ttyUSB0?max_transactions=2", "unknown option"),
        ("rtu:///dev/ttyUSB0?keepalive=on", "unknown option"),
        ("rtu:///dev/ttyUSB0?turnaround_delay=11", "turnaround_delay: must be 0…10 seconds"),
        ("rtu:///dev/ttyUSB0?open_after=-1", "open_after"),
        ("rtu:///dev/ttyUSB0?reopen_first=0", "reopen_first: must be"),
        ("rtu:///dev/ttyUSB0?port_wait=-1", "port_wait: must be"),
        ("ascii:///dev/ttyUSB0?gap_limit=1", "unknown option.*character_timeout"),
        ("ascii:///dev/ttyUSB0?delimiter=128", "delimiter: must be an ASCII character"),
        ("rtu+tcp://127.0.0.1:4001?baud=9600", "unknown option.*connect_timeout"),
        ("rtu+tcp://127.0.0.1:4001?strict_timing=on", "unknown option"),
        ("udp://127.0.0.1?keepalive=on", "unknown option.*local_address"),
        ("udp://127.0.0.1?single_adu_segments=on", "unknown option"),
        ("tcp://127.0.0.1?baud=9600", "unknown option.*max_transactions"),
        ("rtu://ttyUSB0", "three slashes"),
    ],
)
def test_setting_that_cannot_be_is_one_clear_error(endpoint: str, words: str) -> None:
    with pytest.raises(busway.ConfigError, match=words):
        busway.connect(endpoint)


@pytest.mark.clause("S3")
@pytest.mark.parametrize("endpoint", ["rtu:///dev/ttyUSB0", "ascii+tcp://127.0.0.1:4001", "rtu+udp://127.0.0.1:4001"])
def test_unit_must_be_named_on_a_line_and_be_0_to_247(endpoint: str) -> None:
    with busway.connect(endpoint) as link:
        with pytest.raises(busway.InvalidRequest, match="a unit is needed"):
            link.unit()
        for unit in (-1, 248, 255, 256):
            with pytest.raises(busway.InvalidRequest, match="0…247"):
                link.unit(unit)
        with pytest.raises(busway.InvalidRequest, match="nothing was sent"):
            link.unit(0).read_coils(0, count=1)
        assert not link.is_connected
