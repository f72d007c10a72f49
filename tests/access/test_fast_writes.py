"""Writes that are looked at on the fast path: which take it, which do not, and what they leave."""

import json
import os
import struct
from dataclasses import replace
from typing import Any

import pytest
from authorizing import AuthorizedPipeline

from busway.access.audit_log import AuditLog
from busway.access.rules import Policy, Rule
from busway.pdu.exception_response import ExceptionResponse
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.responder import ClientIdentity, RequestContext, ServedUnit
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession

ZONES = Policy.of(
    Rule.of(name="small", addresses="holding:0-4", values=(0, 9)),
    Rule.of(name="free", addresses=["holding:5-9", "coil:0-3"]),
    Rule.of(name="slow", addresses="holding:10-11", rate=1),
)


@pytest.fixture
def device() -> Device:
    return Device(holding_registers=list(range(20)), coils=[True, False] * 4)


@pytest.fixture
def log(tmp_path: Any) -> AuditLog:
    return AuditLog(tmp_path / "audit.jsonl", interval=0)


def session(handler: AuthorizedPipeline, peer: str = "10.0.0.7:5000") -> TcpServerSession:
    return TcpServerSession(
        handler,
        diagnostics=LineDiagnostics(),
        slots=ServerTransactionSlots(16),
        deliver=lambda adu: None,
        client=ClientIdentity(peer=peer, listener="tcp://0.0.0.0:502"),
    )


def ask(one: TcpServerSession, pdu: bytes | str, unit: int = 1) -> str:
    wire = bytes.fromhex(pdu) if isinstance(pdu, str) else pdu
    adu = struct.pack(">HHHB", 1, 0, len(wire) + 1, unit) + wire
    (reply,) = one.receive(adu, len(adu))
    return reply[7:].hex(" ")


def lines(log: AuditLog) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.path.read_text(encoding="ascii").splitlines()]


@pytest.mark.parametrize(
    ("pdu", "facts"),
    [
        ("06 0002 0009", {"function": 6, "address": 2, "count": 1, "old": [2], "new": [9], "rule": "small"}),
        ("06 0005 FFFF", {"address": 5, "old": [5], "new": [0xFFFF], "rule": "free"}),
        ("10 0001 0002 04 00010009", {"function": 16, "address": 1, "count": 2, "old": [1, 2], "new": [1, 9]}),
        ("05 0002 0000", {"function": 5, "address": 2, "count": 1, "old": [1], "new": [0], "rule": "free"}),
        ("05 0001 FF00", {"address": 1, "old": [0], "new": [1]}),
        # No item has the bits behind the third.
        ("0F 0001 0003 01 FD", {"function": 15, "address": 1, "count": 3, "old": [0, 1, 0], "new": [1, 0, 1]}),
    ],
)
def test_a_write_within_a_zone_takes_the_fast_path_and_leaves_its_line(device, log, pdu, facts):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), ZONES, log)
    one = session(handler)
    assert ask(one, pdu).startswith(bytes.fromhex(pdu)[:5].hex(" "))
    assert handler.handled == 0
    (line,) = lines(log)
    assert {key: line[key] for key in facts} == facts
    assert (line["outcome"], line["code"], line["peer"], line["unit"]) == ("done", None, "10.0.0.7:5000", 1)


@pytest.mark.parametrize(
    ("pdu", "reply", "outcome", "rule"),
    [
        ("06 0002 000A", "86 01", "denied", "small"),  # beyond the limits
        ("10 0004 0002 04 00010009", "10 00 04 00 02", "done", "small"),  # over the edge of two zones
        ("10 0001 0002 04 0001000A", "90 01", "denied", "small"),
        ("06 000A 0001", "06 00 0a 00 01", "done", "slow"),  # under a rate
        ("06 000C 0001", "86 01", "denied", "default"),
        ("05 0004 FF00", "85 01", "denied", "default"),
        ("05 0002 0001", "85 01", "denied", "default"),  # no such value: its whole table would have to be permitted
    ],
)
def test_all_else_takes_the_generic_path_and_leaves_its_line_there(device, log, pdu, reply, outcome, rule):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), ZONES, log)
    assert ask(session(handler), pdu) == reply
    assert handler.handled == 1
    (line,) = lines(log)
    assert (line["outcome"], line["rule"]) == (outcome, rule)


@pytest.mark.parametrize("pdu", ["06 0002 000A", "10 0001 0002 04 0001000A", "10 0004 0002 04 0001FFFF"])
def test_limits_are_judged_on_the_fast_path_without_a_log_too(device, pdu):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), ZONES)
    one = session(handler)
    assert ask(one, "06 0002 0009") == "06 00 02 00 09"
    assert ask(one, "10 0001 0002 04 00010009") == "10 00 01 00 02"
    assert handler.handled == 0
    device.holding_registers[0:6] = [7] * 6
    reply = ask(one, pdu)
    assert handler.handled == 1
    assert (reply[:2] == "90" or reply[:2] == "86") == (device.holding_registers[0:6] == [7] * 6)


def test_each_client_leaves_its_own_name(device, log):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), ZONES, log)
    for peer in ("10.0.0.7:1", "10.0.0.8:2", "10.0.0.7:1"):
        ask(session(handler, peer), "06 0005 0001")
    assert [line["peer"] for line in lines(log)] == ["10.0.0.7:1", "10.0.0.8:2", "10.0.0.7:1"]
    assert handler.handled == 0


def test_the_line_stands_in_the_file_before_the_request_is_answered_where_that_is_asked(device, log, monkeypatch):
    order = []
    write = os.write
    monkeypatch.setattr(
        "busway.access.audit_log.os.write", lambda file, data: order.append("line") or write(file, data)
    )
    one = session(AuthorizedPipeline(DeviceResponder({1: device}), ZONES, log))
    for _ in range(2):
        ask(one, "06 0005 0001")
        order.append("answer")
    assert order == ["line", "answer"] * 2


def test_lines_are_in_the_order_of_what_was_written_by_whatever_path(device, log):
    one = session(AuthorizedPipeline(DeviceResponder({1: device}), ZONES, log))
    adus = b""
    for value, address in enumerate([5, 5, 12, 5, 10, 5], 1):
        adus += struct.pack(">HHHBBHH", value, 0, 6, 1, 6, address, value)
    one.receive(adus, len(adus))
    assert [(line["old"], line["new"]) for line in lines(log)] == [
        ([5], [1]),
        ([1], [2]),
        (None, [3]),
        ([2], [4]),
        ([10], [5]),
        ([4], [6]),
    ]


def test_a_log_that_takes_no_writes_has_them_refused_on_the_generic_path(device, tmp_path):
    log = AuditLog(tmp_path / "log", interval=0, on_failure="refuse")
    handler = AuthorizedPipeline(DeviceResponder({1: device}), ZONES, log)
    one = session(handler)
    assert ask(one, "06 0005 0001") == "06 00 05 00 01"
    log.close()
    assert ask(one, "06 0005 0002") == "86 04"
    assert (device.holding_registers[5], handler.handled) == (1, 1)


def test_a_policy_that_is_replaced_holds_for_writes_that_were_compiled(device, log):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), ZONES, log)
    one = session(handler)
    ask(one, "06 0005 0001")
    handler.replace_policy(Policy.of(Rule.of(name="other", addresses="holding:0-9")))
    ask(one, "06 0005 0002")
    handler.replace_policy(Policy.read_only())
    assert ask(one, "06 0005 0003") == "86 01"
    assert [line["rule"] for line in lines(log)] == ["free", "other", "default"]
    assert device.holding_registers[5] == 2


def test_a_hook_takes_writes_back_to_the_generic_path(device, log):
    handler = AuthorizedPipeline(DeviceResponder({1: device}), ZONES, log)
    one = session(handler)
    ask(one, "06 0005 0001")
    seen = []
    device.on_write("holding_registers", seen.append)
    ask(one, "06 0005 0002")
    ask(one, "05 0001 FF00")
    assert (len(seen), handler.handled, len(lines(log))) == (1, 1, 3)


def test_a_device_that_changes_its_answers_is_not_bypassed(device, log):
    class Refusing(DeviceResponder):
        def serves(self, unit: int) -> ServedUnit | None:
            served = super().serves(unit)
            return served and replace(served, is_direct=False)

        def answer(self, context: RequestContext, request: Any) -> Any:
            return ExceptionResponse(context.function, 4)

    handler = AuthorizedPipeline(Refusing({1: device}), ZONES, log)
    assert ask(session(handler), "06 0005 0001") == "86 04"
    assert handler.handled == 1
    assert ask(session(AuthorizedPipeline(Refusing({1: device}), ZONES)), "06 0002 0001") == "86 04"
    assert lines(log)[0]["rule"] == "free"


def test_what_one_unit_may_is_not_what_another_may(device, log):
    policy = Policy.of(Rule.of(name="one", units=1, addresses="holding:0-9"))
    handler = AuthorizedPipeline(DeviceResponder({1: device, 2: Device(holding_registers=10)}), policy, log)
    one = session(handler)
    assert ask(one, "06 0005 0001") == "06 00 05 00 01"
    assert ask(one, "06 0005 0001", unit=2) == "86 01"
    assert [(line["unit"], line["outcome"]) for line in lines(log)] == [(1, "done"), (2, "denied")]
