"""The way of a forwarded request is the one that the architecture page shows: at most eight functions, and up once."""

import contextlib
import re
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from waiting import until
from whole_frames import line_of_whole_frames

import busway
from busway.access.audit_log import AuditLog
from busway.apps.gateway.forwarding import ForwardTarget
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings, simple_plan
from busway.apps.gateway.routes import Route, RoutingTable
from busway.client.link import AsyncLinkDriver
from busway.observe.metrics.observer import MetricsObserver
from busway.observe.metrics.request_tally import RequestTally
from busway.server.connection import ServerConnection
from busway.server.listener import Listener
from busway.session.responder import RequestContext
from busway.session.serial_client import SerialClientSession
from busway.session.tcp_client import TcpClientSession

ROOT = Path(__file__).resolve().parents[3]
SOURCES = f"{ROOT / 'src' / 'busway'}/"
JOURNEY = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").partition("## Journey 3")[2]
DOWN = re.findall(r"^\| [1-7] \| `([\w/.]+)` \| `([\w.]+)` \|", JOURNEY.partition("The first time")[0], re.MULTILINE)
OTHERS = {
    title: re.findall(r"`([\w/.]+)` `([\w.]+)`", steps)
    for title, steps in re.findall(r"^\| ((?:a|an) [^|]+) \| (.+) \|$", JOURNEY, re.MULTILINE)
}
"""By listener, the steps before the fourth; by upstream, those after the fifth."""
MOST_NAMES = 8
BAUD = 115_200


def callers(frame: FrameType | None) -> list[tuple[str, str]]:
    """The functions of busway that are being called, outermost first: file and name."""
    found = []
    while frame is not None:
        if frame.f_code.co_filename.startswith(SOURCES) and "transport/" not in frame.f_code.co_filename:
            owner = type(frame.f_locals["self"]).__name__ if "self" in frame.f_locals else ""
            name = f"{owner}.{frame.f_code.co_name}"
            found.append((frame.f_code.co_filename.removeprefix(SOURCES), name))
        frame = frame.f_back
    return found[::-1]


def seen(monkeypatch: pytest.MonkeyPatch, of: Any, name: str, ways: list[list[tuple[str, str]]]) -> None:
    """Keep, at each call of a function, the functions of busway that are being called, itself last."""
    inner = getattr(of, name)
    last = (inner.__code__.co_filename.removeprefix(SOURCES), f"{of.__name__}.{name}")

    def wrapper(self: Any, *arguments: Any, **options: Any) -> Any:
        ways.append([*callers(sys._getframe(1)), last])
        return inner(self, *arguments, **options)

    monkeypatch.setattr(of, name, wrapper)


@pytest.mark.parametrize("around", ["nothing", "policy, audit log and metrics"])
async def test_a_read_that_was_routed_before_goes_by_eight_functions_and_comes_back_by_one_climb(
    around: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ways: list[list[tuple[str, str]]] = []
    answers: list[list[tuple[str, str]]] = []
    tally = RequestTally()

    seen(monkeypatch, TcpClientSession, "_launch", ways)
    seen(monkeypatch, ServerConnection, "deliver_together", answers)
    async with busway.serve("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=[7] * 10)}) as behind:
        with contextlib.ExitStack() as open_files:
            options: dict[str, Any] = {}
            if around != "nothing":
                options["policy"] = busway.Policy.of(busway.Rule.of(units=1, action="read-only"))
                options["observers"] = [MetricsObserver(tally)]
                options["audit"] = open_files.enter_context(AuditLog(tmp_path / "audit"))
            plan = simple_plan(["tcp://127.0.0.1:0"], behind.endpoints[0])
            async with Gateway(plan, **options) as gateway, busway.open(gateway.endpoints[0]) as link:
                for _ in range(3):
                    assert await link.unit(1).read_holding_registers(0, count=2) == [7, 7]
    assert tally.total() == (0 if around == "nothing" else 3)
    at_gateway = [way for way in ways if way[0][1] == "ServerConnection.buffer_updated"]
    assert at_gateway[-1] == DOWN
    assert len(DOWN) <= MOST_NAMES
    back = [name for _, name in answers[-1]]
    assert back[0] == "_LinkProtocol.buffer_updated"
    assert back[-4:] == [
        "Forwarder.answer_completed",
        "Forwarder.send",
        "ForwardedReads.send",
        "ServerConnection.deliver_together",
    ]
    assert AsyncLinkDriver.__name__ not in "".join(back[4:])  # from the link up, and not down again


async def asked(kind: str, link: busway.AsyncLink) -> None:
    if kind == "write":
        await link.unit(1).write_multiple_registers(0, [1, 2])
    elif kind == "broadcast":
        await link.unit(0).write_multiple_registers(0, [1, 2])
    else:
        assert await link.unit(1).read_holding_registers(4, count=4) == [7] * 4


@pytest.mark.parametrize("upstream", ["tcp", "rtu+tcp"])
@pytest.mark.parametrize("kind", ["read", "write", "broadcast", "split read", "remembered read"])
@pytest.mark.parametrize(
    "listener", ["tcp", "udp", "rtu+tcp", pytest.param("serial port", marks=pytest.mark.real_time)]
)
async def test_every_request_of_every_listener_goes_the_way_of_the_page_and_comes_back_by_one_climb(
    listener: str, kind: str, upstream: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    down: list[list[tuple[str, str]]] = []
    up: list[list[tuple[str, str]]] = []
    sent: list[list[tuple[str, str]]] = []
    seen(monkeypatch, TcpClientSession, "_launch", down)
    seen(monkeypatch, SerialClientSession, "transmit", down)
    seen(monkeypatch, RequestContext, "reply", up)
    seen(monkeypatch, ForwardTarget, "ask", sent)
    options: dict[str, Any] = {"turnaround_delay": 0.001} if upstream == "rtu+tcp" else {"broadcast": True}
    limits: dict[str, Any] = {"split read": {"max_registers": 2}, "remembered read": {"cache": 60.0}}.get(kind, {})
    async with contextlib.AsyncExitStack() as stack:
        serial = listener == "serial port"
        paths = stack.enter_context(line_of_whole_frames(ports=2, baud=BAUD)).paths if serial else []
        urls = [f"rtu://{path}?baud={BAUD}" for path in paths]
        devices = {unit: busway.Device(holding_registers=[7] * 10) for unit in (0, 1) if unit or upstream == "tcp"}
        behind = await stack.enter_async_context(busway.serve(f"{upstream}://127.0.0.1:0", units=devices))
        plan = GatewayPlan(
            listeners=(GatewayListener("one", Listener(urls[0] if serial else f"{listener}://127.0.0.1:0")),),
            upstreams=(UpstreamSettings.of("line", behind.endpoints[0], **options),),
            table=RoutingTable((Route(upstream="line", units=frozenset(range(1, 248)), **limits),)),
        )
        gateway = await stack.enter_async_context(Gateway(plan))
        link = await stack.enter_async_context(busway.open(urls[1] if serial else gateway.endpoints[0]))
        for _ in range(2):  # at first the upstream is connected
            for device in devices.values():
                device.holding_registers[0] = 7
            await asked(kind, link)
            if kind == "broadcast":  # no reply shows that the gateway has taken it
                await until(lambda: any(device.holding_registers[0] == 1 for device in devices.values()))
            await until(lambda: not gateway.open_requests)
        if kind == "remembered read":
            assert len(sent) == 1, "the second one is answered with what is remembered"
            assert len(sent[0]) <= MOST_NAMES
            return
    first = OTHERS["a serial port" if serial else f"a listener {LISTENERS[listener]}"]
    if kind == "broadcast" and first[-1][1].startswith("SerialServerSession"):
        first = [*first, ("session/serial_server.py", "SerialServerSession._broadcast")]
    if kind == "read" and listener in ("tcp", "udp"):
        first = [*first[:2], DOWN[2]]
    last = DOWN[5:]
    if upstream != "tcp":
        last = OTHERS["a serial upstream"]
    elif kind == "split read":
        last = OTHERS["an upstream on TCP that takes no more at once"]
    ours = [way for way in down if DOWN[3] in way]
    assert ours[-1] == [*first, *DOWN[3:5], *last]
    assert len(ours[-1]) <= MOST_NAMES
    for back in (way for way in up if way[0][1] == "_LinkProtocol.buffer_updated"):
        names = [name for _, name in back]
        assert names[1:3] == ["AsyncLinkDriver.received", "AsyncLinkDriver._wake"]
        assert "AsyncLinkDriver" not in "".join(names[3:])  # from the link up, and not down again


LISTENERS = {"tcp": "on TCP", "udp": "on UDP", "rtu+tcp": "in RTU or ASCII over TCP"}
