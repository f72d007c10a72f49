"""What the operator of a gateway is told of its lines."""

import asyncio
import os
from pathlib import Path

import pytest
from waiting import until

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import simple_plan
from busway.apps.gateway.upstream_log import UpstreamLog
from busway.options.ports import SerialSettings
from busway.testing.line import PacedLine
from busway.transport.serial.blocking import BlockingSerialPort

ANY_PORT = "tcp://127.0.0.1:0"
LOG = "busway.apps.gateway"


class Clock:
    """Seconds that pass when a test says so."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def news(clock: Clock | None = None, *, is_waited_for: bool = True) -> UpstreamLog:
    return UpstreamLog("hall", "rtu:///dev/ttyX", is_waited_for=is_waited_for, clock=clock or Clock())


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [one.getMessage() for one in caplog.records if one.name == LOG]


def test_a_reason_is_told_once_and_again_when_it_changes(caplog: pytest.LogCaptureFixture) -> None:
    line = news()
    for reason in ("it is not there", "it is not there", "it is held by mbpoll", "it is not there"):
        line.is_down(reason)
    line.is_up()
    line.is_up()
    assert told(caplog) == [
        "rtu:///dev/ttyX: it is not there; waiting for it",
        "rtu:///dev/ttyX: it is held by mbpoll; waiting for it",
        "rtu:///dev/ttyX: it is not there; waiting for it",
        "rtu:///dev/ttyX: open again",
    ]


def test_requests_that_got_0a_are_told_once_then_counted(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    line = news(clock)
    for _ in range(1000):
        line.no_path("it is not there")
    clock.now = 61.0
    line.no_path("it is not there")
    line.no_path("it is not there")
    line.is_up()
    assert told(caplog) == [
        "line hall: a request was answered 0A: it is not there",
        "line hall: 1000 more requests were answered 0A within 61 s: it is not there",
        "line hall: 1 more request was answered 0A within 0 s: it is not there",
    ]


def test_each_silent_unit_is_told_once_in_ten_minutes_with_the_number_of_further_requests(
    caplog: pytest.LogCaptureFixture,
) -> None:
    clock = Clock()
    line = news(clock)
    for unit in (7, 7, 9, 7):
        line.no_answer(unit, "no reply within 1 s")
    clock.now = 601.0
    line.no_answer(7, "not asked")
    assert told(caplog) == [
        "line hall: a request to unit 7 was answered 0B: no reply within 1 s",
        "line hall: a request to unit 9 was answered 0B: no reply within 1 s",
        "line hall: a request to unit 7 was answered 0B: not asked (2 more since the last line)",
    ]


@pytest.mark.real_time
def test_another_reason_for_0a_is_told_at_once(caplog: pytest.LogCaptureFixture) -> None:
    line = news()
    for reason in ("it is not there", "it is not there", "64 calls wait"):
        line.no_path(reason)
    assert told(caplog)[-2:] == [
        "line hall: 1 more request was answered 0A within 0 s: it is not there",
        "line hall: a request was answered 0A: 64 calls wait",
    ]


@pytest.mark.real_time
async def test_a_port_that_is_missing_is_told_at_the_start_before_anything_is_asked(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    port = tmp_path / "ttyX"
    plan = simple_plan([ANY_PORT], f"rtu://{port}", reopen_first=0.02, reopen_most=0.05)
    with PacedLine(ports=2, baud=19200) as line:
        async with Gateway(plan) as gateway:
            await until(lambda: told(caplog))
            (status,) = gateway.status().upstreams
            assert status.indicators.error.value == "flashing"
            assert status.indicators.device_status.value == "off"
            (link,) = status.links
            assert link.reason == f"{port} cannot be opened: it is not there"
            os.symlink(line.paths[0], port)
            await until(lambda: len(told(caplog)) > 1)
            assert told(caplog) == [
                f"rtu://{port}: {port} cannot be opened: it is not there; waiting for it",
                f"rtu://{port}: open again",
            ]
            (status,) = gateway.status().upstreams
            assert (status.links[0].reason, status.links[0].next_attempt) == ("", None)
            assert status.indicators.error.value == "off"
        assert len(told(caplog)) == 2  # that the gateway ends is no news of its line


@pytest.mark.real_time
async def test_a_port_that_is_busy_is_told_with_its_holder_and_0a_says_the_same(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with PacedLine(ports=2, baud=19200) as line:
        holder = await asyncio.to_thread(BlockingSerialPort, line.paths[0], SerialSettings(baud=19200))
        plan = simple_plan([ANY_PORT], f"rtu://{line.paths[0]}?baud=19200", reopen_first=0.05, reopen_most=5.0)
        try:
            async with Gateway(plan) as gateway, busway.open(gateway.endpoints[0], shared=False) as link:
                await until(lambda: told(caplog))
                for _ in range(5):
                    with pytest.raises(busway.ExceptionReply, match="exception 0A"):
                        await link.unit(1).read_holding_registers(0, count=1)
                first, then = told(caplog)
                assert "it is held by" in first
                assert first.endswith("; waiting for it")
                reason = first.removesuffix("; waiting for it").partition(": ")[2]
                assert then == f"line line: a request was answered 0A: {reason}"
        finally:
            holder.close()


async def test_a_server_that_refuses_is_told_when_it_is_asked(caplog: pytest.LogCaptureFixture) -> None:
    plan = simple_plan([ANY_PORT], "tcp://127.0.0.1:1")
    async with Gateway(plan) as gateway, busway.open(gateway.endpoints[0], shared=False) as link:
        assert told(caplog) == []
        with pytest.raises(busway.ExceptionReply, match="exception 0A"):
            await link.unit(1).read_holding_registers(0, count=1)
        assert told(caplog)[0].endswith("; tried again when something is asked")
        (status,) = gateway.status().upstreams
        assert status.links[0].reason.startswith("no connection: ")
