"""The handler around a handler: it is not in the way, hands on what it has, and refuses nothing that is not a fault."""

import json
from collections.abc import Mapping
from pathlib import Path

import pytest

import busway
from busway.access.audit import AuditLog
from busway.faults.switchboard import FaultSwitchboard
from busway.pdu.direct import Answer
from busway.pdu.functions import STANDARD, AnyRequest
from busway.pdu.message import Message
from busway.server.local import LocalHandler
from busway.session.diagnostics import CommunicationState
from busway.session.handler import Outcome, ReadPlanner, RequestContext, UnitHolder, WriteObserver
from busway.testing import known_device

READ = bytes.fromhex("03 0005 0002")


def _context(unit: int = 1, function: int = 3) -> RequestContext:
    return RequestContext(unit=unit, function=function, diagnostics=CommunicationState(), peer="a", listener="b")


def test_short_road_and_plans_are_those_of_the_handler_inside_until_a_fault_is_on_and_again_when_it_is_off() -> None:
    inner = LocalHandler({1: known_device()})
    board = FaultSwitchboard()
    handler = board.around(inner)
    generations = [handler.generation]
    assert handler.direct(_context()) is inner.direct(_context())
    assert handler.plans(_context()) is inner.plans(_context())
    assert handler.plan(_context(), READ) is not None
    name = board.add("late", units={200})
    generations.append(handler.generation)
    assert handler.direct(_context()) == {}
    assert handler.plans(_context()) == {}
    assert handler.plan(_context(), READ) is None
    board.switch(name, on=False)
    generations.append(handler.generation)
    assert handler.direct(_context()) is inner.direct(_context())
    assert handler.plans(_context()) is inner.plans(_context())
    assert len(set(generations)) == 3


def test_handler_is_what_the_handler_inside_is() -> None:
    handler = FaultSwitchboard().around(LocalHandler({1: known_device(), 7: known_device()}))
    assert isinstance(handler, UnitHolder)
    assert isinstance(handler, ReadPlanner)
    assert isinstance(handler, WriteObserver)
    assert handler.serial_units == {1, 7}
    assert handler.functions is STANDARD
    assert not isinstance(FaultSwitchboard().around(_Plain()), UnitHolder)


class _Plain:
    """A handler with nothing but what every handler has."""

    functions = STANDARD
    generation = 0

    def direct(self, context: RequestContext) -> Mapping[int, Answer]:
        return {}

    def handle(self, context: RequestContext, request: AnyRequest) -> Outcome:
        raise busway.Refusal(4)


def test_request_of_a_way_that_nobody_knows_is_answered_rightly() -> None:
    board = FaultSwitchboard()
    board.add("wedged")
    reply = board.around(LocalHandler({1: known_device()})).handle(_context(), STANDARD.decode_request(READ))
    assert isinstance(reply, Message)
    assert reply.encode() == bytes.fromhex("03 04 0005 0006")
    plain = board.around(_Plain())
    assert plain.plans(_context()) == {}
    assert plain.plan(_context(), READ) is None
    request = STANDARD.decode_request(bytes.fromhex("06 0001 0002"))
    assert isinstance(request, busway.Request)
    with pytest.raises(busway.Refusal):
        plain.observe_write(_context(function=6), request, lambda replaced: None)


async def test_audit_log_of_a_server_has_the_write_that_was_executed_and_not_answered(tmp_path: Path) -> None:
    board = FaultSwitchboard()
    board.add("execute-then-drop")
    log = AuditLog(tmp_path / "audit.jsonl")
    server = busway.serve("tcp://127.0.0.1:0", units=known_device(), audit=log)
    board.attach(server)
    async with server, busway.open(server.endpoints[0], timeout=5, retries=0) as link:
        with pytest.raises(busway.WriteOutcomeUnknown):
            await link.unit(1).write_single_register(5, 7)
        assert await link.unit(1).read_holding_registers(5, count=1) == [7]
    log.close()
    (line,) = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text(encoding="utf-8").splitlines()]
    assert (line["function"], line["address"], line["old"], line["new"]) == (6, 5, [5], [7])
