"""Windows on the fast path: every range of a small world, against the decision of the policy."""

import json
import struct

import pytest

from busway.access.access_request import AccessRequest
from busway.access.audit_log import AuditLog
from busway.access.fast_path_rights import bind
from busway.access.rule_evaluation import Rights, decision_of
from busway.access.rules import Action, Policy, Rule
from busway.codes import Table
from busway.pdu.fields import u16
from busway.pdu.functions import STANDARD
from busway.pdu.message import Request, Span, Touch
from busway.pdu.unknown_functions import OpaqueReply
from busway.server.device import Device
from busway.session.responder import ClientIdentity, ServedUnit


def bound(policy, code, audit=None):
    """The answer of a function on a device of 64 items, as rights leave it to the fast path; None without one."""
    device = Device(holding_registers=64, coils=64, input_registers=64, discrete_inputs=64)
    rights = Rights(policy.rules, policy.default)
    return bind(rights, 1, ServedUnit(1, device), STANDARD.find(bytes((code,)), 0, 1), audit)


LIMITED = Policy.of(Rule.of(addresses="holding:3-8", values=(0, 9)), default="allow")
POLICIES = [
    Policy.of(Rule.of(table="holding", addresses="3-6"), Rule.of(table="coil", addresses="3-6")),
    Policy.of(Rule.of(addresses=["holding:3-6", "holding:9-11", "coil:2", "coil:4"])),
    Policy.of(Rule.of(action="deny", addresses="holding:5-6,coil:5"), default="allow"),
    Policy.of(Rule.of(addresses="holding:3-6", access="read"), Rule.of(addresses="holding:7-8"), default="deny"),
    Policy.of(Rule.of(addresses="holding:3-8", rate=5), Rule.of(addresses="holding:0-12"), default="deny"),
    LIMITED,
]


def pdu_of(code, address, count):
    """A request of a function, complete."""
    if code in (5, 6):
        return struct.pack(">BHH", code, address, 0xFF00 if code == 5 else 7)
    head = struct.pack(">BHH", code, address, count)
    if code in (1, 3):
        return head
    size = (count + 7) // 8 if code == 15 else 2 * count
    return head + bytes((size,)) + bytes(size)


def crosses(zone, first, end):
    """Whether a range is neither within a zone nor outside of it."""
    return first < zone[1] and end > zone[0] and not (zone[0] <= first and end <= zone[1])


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("code", [1, 3, 5, 6, 15, 16])
def test_the_check_passes_exactly_what_is_plainly_permitted(policy, code):
    check = bound(policy, code) or (lambda *_: None)
    for address in range(14):
        for count in (1,) if code in (5, 6) else range(1, 14):
            pdu = pdu_of(code, address, count)
            decision = decision_of(policy, AccessRequest.of(STANDARD.decode_request(pdu), unit=1))
            # A write within limits is bound too, where one zone takes the whole of it.
            is_limited = bool(decision.rates) or (
                policy is LIMITED and code in (6, 16) and crosses((3, 9), address, address + count)
            )
            passed = check(b"ab" + pdu + b"c", 2, 2 + len(pdu), ClientIdentity()) is not None
            assert passed == (decision.allowed and not is_limited)


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_what_is_cut_off_is_left_to_the_generic_path_and_to_the_answer(size):
    for code in (1, 3, 5, 6):
        check = bound(POLICIES[1], code)
        pdu = struct.pack(">BHH", code, 3, 1)[:size]
        assert check(pdu, 0, size, ClientIdentity()) is None
        assert check(pdu + bytes(8), 0, size, ClientIdentity()) is None


def test_what_is_permitted_everywhere_is_bound_and_what_is_nowhere_is_not():
    found = {code for code in (1, 2, 3, 4, 5, 6, 15, 16) if bound(Policy.read_only(), code)}
    assert found == {1, 2, 3, 4}


def test_with_a_log_a_write_leaves_its_line_and_a_write_that_cannot_is_not_bound(tmp_path):
    class Own(Request):
        code = 100
        writes = Touch(Table.HOLDING_REGISTERS)
        address: int = u16()

        class Reply(OpaqueReply):
            """Anything."""

        @classmethod
        def direct(cls, model):
            return lambda buffer, at, end, client: b"\x64"

    log = AuditLog(tmp_path / "log", interval=0)
    write = bound(Policy.allow_all(), 6, log)
    assert write(b"\x06\0\1\0\2", 0, 5, ClientIdentity(peer="me")) == b"\x06\0\1\0\2"
    (line,) = log.path.read_text().splitlines()
    assert json.loads(line)["peer"] == "me"
    rights = Rights((), Action.ALLOW)
    served = ServedUnit(1, Device(holding_registers=1))
    assert bind(rights, 1, served, Own, log) is None
    assert bind(rights, 1, served, Own) is not None


def test_a_function_that_says_for_itself_what_it_touches_takes_the_generic_path():
    class Own(Request):
        code = 100

        class Reply(OpaqueReply):
            """Anything."""

        @classmethod
        def direct(cls, model):
            return lambda buffer, at, end, client: b"\x64"

        def spans(self) -> tuple[Span, ...]:
            return ()

    assert bind(Rights((), Action.ALLOW), 1, ServedUnit(1, Device(holding_registers=1)), Own) is None
