"""The way of a forwarded read is the one that the architecture page shows: at most eight functions, and up once."""

import re
import sys
from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import busway
from busway.access.audit_log import AuditLog
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.settings import simple_plan
from busway.client.link import AsyncLinkDriver
from busway.observe.metrics.observer import MetricsObserver
from busway.observe.metrics.request_tally import RequestTally
from busway.server.connection import ServerConnection
from busway.session.client import TcpClientSession

ROOT = Path(__file__).resolve().parents[3]
SOURCES = f"{ROOT / 'src' / 'busway'}/"
JOURNEY = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").partition("## Journey 3")[2]
DOWN = re.findall(r"^\| [1-8] \| `([\w/.]+)` \| `([\w.]+)` \|", JOURNEY.partition("The way back")[0], re.MULTILINE)
MOST_NAMES = 8


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


@pytest.mark.parametrize("around", ["nothing", "policy, audit log and metrics"])
async def test_a_read_that_was_routed_before_goes_by_eight_functions_and_comes_back_by_one_climb(
    around: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ways: list[list[tuple[str, str]]] = []
    answers: list[list[tuple[str, str]]] = []
    tally = RequestTally()

    def seen(of: Any, name: str, ways: list[list[tuple[str, str]]]) -> None:
        inner = getattr(of, name)

        def wrapper(self: Any, *arguments: Any, **options: Any) -> Any:
            ways.append(
                [
                    *callers(sys._getframe(1)),
                    (inner.__code__.co_filename.removeprefix(SOURCES), f"{of.__name__}.{name}"),
                ]
            )
            return inner(self, *arguments, **options)

        monkeypatch.setattr(of, name, wrapper)

    seen(TcpClientSession, "_launch", ways)
    seen(ServerConnection, "deliver_together", answers)
    async with busway.serve("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=[7] * 10)}) as behind:
        with ExitStack() as open_files:
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
    assert back[-4:] == ["Forwarder.look", "Forwarder.send", "ForwardedReads.send", "ServerConnection.deliver_together"]
    assert AsyncLinkDriver.__name__ not in "".join(back[4:])  # from the link up, and not down again
