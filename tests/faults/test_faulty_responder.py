"""The handler around a handler: it is not in the way, hands on what it has, and refuses nothing that is not a fault."""

import json
from pathlib import Path
from typing import Any

import pytest

import busway
from busway.access.audit_log import AuditLog
from busway.faults.switchboard import FaultSwitchboard
from busway.pdu.functions import STANDARD, AnyRequest
from busway.pdu.message import Message
from busway.server.device_responder import DeviceResponder
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import ClientIdentity, RequestContext, ResponderAnswer, SerialUnits, ServedUnit
from busway.session.server_pipeline import RequestPipeline
from busway.testing import known_device

READ = bytes.fromhex("03 0005 0002")


def _context(unit: int = 1, function: int = 3) -> RequestContext:
    return RequestContext(
        unit=unit, function=function, diagnostics=CommunicationState(), client=ClientIdentity(peer="a", listener="b")
    )


def test_fast_path_is_that_of_the_responder_inside_until_a_fault_is_on_and_again_when_it_is_off() -> None:
    inner = DeviceResponder({1: known_device()})
    switchboard = FaultSwitchboard()
    responder = switchboard.around(inner)
    pipeline = RequestPipeline(responder)
    fast = pipeline.fast_path(ClientIdentity())
    generations = [responder.generation]
    assert responder.serves(1) is inner.serves(1)
    asked = bytes.fromhex("0000 0006 01 03")  # protocol, length, unit and function code
    assert fast.bind(asked).answer is not None
    name = switchboard.add("late", units={200})
    generations.append(responder.generation)
    served = responder.serves(1)
    assert served is not None
    assert not served.is_direct
    during = pipeline.fast_path(ClientIdentity())
    assert during is not fast
    assert during.bind(asked).answer is None
    switchboard.switch(name, on=False)
    generations.append(responder.generation)
    assert responder.serves(1) is inner.serves(1)
    assert len(set(generations)) == 3


def test_responder_serves_what_the_responder_inside_serves() -> None:
    responder = FaultSwitchboard().around(DeviceResponder({1: known_device(), 7: known_device()}))
    assert [unit for unit in range(256) if unit in SerialUnits(responder)] == [1, 7]
    assert responder.functions is STANDARD
    assert FaultSwitchboard().around(_Plain()).serves(1) is None


class _Plain:
    """A handler with nothing but what every handler has."""

    functions = STANDARD
    generation = 0

    def serves(self, unit: int) -> ServedUnit | None:
        return None

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        raise busway.Refusal(4)


def test_request_of_an_unknown_transport_is_answered_rightly() -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("wedged")
    reply = switchboard.around(DeviceResponder({1: known_device()})).answer(_context(), STANDARD.decode_request(READ))
    assert isinstance(reply, Message)
    assert reply.encode() == bytes.fromhex("03 04 0005 0006")
    with pytest.raises(busway.Refusal):
        switchboard.around(_Plain()).answer(_context(), STANDARD.decode_request(READ))


def _audited(switchboard: FaultSwitchboard, log: AuditLog) -> busway.Server:
    server = busway.serve("tcp://127.0.0.1:0", units=known_device(), audit=log)
    switchboard.attach(server)
    return server


def _lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


async def test_audit_line_of_a_write_that_a_fault_swallows_says_what_was_executed_and_that_there_was_no_answer(
    tmp_path: Path,
) -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("execute-then-drop")
    with AuditLog(tmp_path / "audit.jsonl") as log:
        async with _audited(switchboard, log) as server, busway.open(server.endpoints[0], timeout=5, retries=0) as link:
            with pytest.raises(busway.WriteOutcomeUnknown):
                await link.unit(1).write_single_register(5, 7)
            assert await link.unit(1).read_holding_registers(5, count=1) == [7]
    (line,) = _lines(tmp_path / "audit.jsonl")
    assert (line["function"], line["address"], line["old"], line["new"]) == (6, 5, [5], [7])
    assert line["outcome"] == "no answer"


@pytest.mark.parametrize(
    ("fault", "options"), [("late", {"delay": 0.02}), ("dribble", {}), ("glue", {}), ("min-gap", {})]
)
async def test_audit_line_of_a_write_whose_answer_a_fault_delays_or_cuts_says_that_it_was_done(
    fault: str, options: dict[str, Any], tmp_path: Path
) -> None:
    switchboard = FaultSwitchboard()
    switchboard.add(fault, parameters=options)
    with AuditLog(tmp_path / "audit.jsonl") as log:
        async with _audited(switchboard, log) as server, busway.open(server.endpoints[0], timeout=5, retries=0) as link:
            await link.unit(1).write_single_register(5, 7)
    (line,) = _lines(tmp_path / "audit.jsonl")
    assert (line["old"], line["new"], line["outcome"]) == ([5], [7], "done")


async def test_audit_line_of_a_write_that_a_fault_refuses_has_its_exception_code(tmp_path: Path) -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("busy")
    with AuditLog(tmp_path / "audit.jsonl") as log:
        async with _audited(switchboard, log) as server, busway.open(server.endpoints[0], timeout=5, retries=0) as link:
            with pytest.raises(busway.ExceptionReply):
                await link.unit(1).write_single_register(5, 7)
    (line,) = _lines(tmp_path / "audit.jsonl")
    assert (line["outcome"], line["code"], line["old"]) == ("exception", 6, None)
