"""A link that asks before it sends, and tells which requests may still be on their way."""

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from busway.apps.collector.permitted_link import PermittedLink
from busway.errors import BadReply, ExceptionReply, LinkDown, NoReply, Overloaded, UnitSuspended
from busway.pdu.message import Request
from busway.pdu.read_items import ReadHoldingRegisters


class Answering:
    """A link whose last request of a call has this outcome; the first one is answered."""

    def __init__(self, outcome: Any) -> None:
        self.outcome, self.asked = outcome, 0

    async def run(self, unit: int, requests: Sequence[Request], call_options: Any) -> list[Any]:
        self.asked += len(requests)
        if isinstance(self.outcome, asyncio.CancelledError):
            raise self.outcome
        return [b"", self.outcome]


def asked(link: Answering, permit: Callable[[str], None], told: list[str]) -> PermittedLink:
    return PermittedLink("hall", link, permit, told.append)


@pytest.mark.parametrize(
    ("outcome", "may_be_on_its_way"),
    [
        (b"", False),
        (ExceptionReply(2), False),
        (Overloaded("full"), False),
        (UnitSuspended("silent", next_probe=1.0), False),
        (LinkDown("refused", kind="refused", sent=False), False),
        (LinkDown("reset", kind="lost", sent=True), True),
        (NoReply("silent"), True),
        (BadReply("of another unit", kind="unit"), True),
        (asyncio.CancelledError(), True),
    ],
    ids=repr,
)
async def test_a_request_without_a_valid_reply_may_be_on_its_way(outcome: Any, may_be_on_its_way: bool) -> None:
    told: list[str] = []
    link = asked(Answering(outcome), lambda _: None, told)
    try:
        await link.run(1, [ReadHoldingRegisters(0, 1)] * 2, {})
    except asyncio.CancelledError:
        assert isinstance(outcome, asyncio.CancelledError)
    assert told == ["hall"] * may_be_on_its_way


async def test_without_permission_nothing_is_sent_and_nothing_is_on_its_way() -> None:
    def refuse(name: str) -> None:
        raise LinkDown(f"{name} is another collector's", kind="other")

    told: list[str] = []
    inner = Answering(b"")
    outcomes = await asked(inner, refuse, told).run(1, [ReadHoldingRegisters(0, 1)] * 2, {})
    assert [str(each) for each in outcomes] == ["hall is another collector's"] * 2
    assert (inner.asked, told) == (0, [])
