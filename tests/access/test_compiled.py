"""Windows on the short road: every range of a small world, against the decision of the policy."""

import struct

import pytest

from busway.access.compiled import permitted_answers
from busway.access.question import Question
from busway.access.rules import Policy, Rule
from busway.pdu.functions import STANDARD, FunctionTable
from busway.pdu.general import OpaqueReply
from busway.pdu.message import Request, Span


def answer(buffer, at, end):
    return bytes(buffer[at:end])


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


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("code", [1, 3, 5, 6, 15, 16])
def test_the_check_passes_exactly_what_is_plainly_permitted(policy, code):
    check = permitted_answers(policy, 1, STANDARD, {code: answer}, audited=False).get(code, lambda *_: None)
    for address in range(14):
        for count in (1,) if code in (5, 6) else range(1, 14):
            pdu = pdu_of(code, address, count)
            decision = policy.decide(Question.of(STANDARD.decode_request(pdu), unit=1))
            is_bound = bool(decision.rates) or (
                policy is LIMITED and code in (6, 16) and address < 9 and address + count > 3
            )
            passed = check(b"ab" + pdu + b"c", 2, 2 + len(pdu)) is not None
            assert passed == (decision.allowed and not is_bound)


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_what_is_cut_off_is_left_to_the_long_road_and_to_the_answer(size):
    policy = POLICIES[1]

    def judge(buffer, at, end):
        assert end - at == size
        return

    offered = permitted_answers(policy, 1, STANDARD, dict.fromkeys((1, 3, 5, 6), judge), audited=False)
    for code, check in offered.items():
        pdu = struct.pack(">BHH", code, 3, 1)[:size]
        assert check(pdu, 0, size) is None
        assert check(pdu + bytes(8), 0, size) is None


def test_what_is_permitted_everywhere_is_offered_as_it_is():
    offered = permitted_answers(
        Policy.read_only(), 1, STANDARD, dict.fromkeys((1, 2, 3, 4, 5, 6, 15, 16), answer), audited=False
    )
    assert offered == dict.fromkeys((1, 2, 3, 4), answer)


def test_with_a_log_no_write_takes_the_short_road():
    offered = permitted_answers(Policy.allow_all(), 1, STANDARD, dict.fromkeys((1, 3, 5, 6, 16), answer), audited=True)
    assert offered == dict.fromkeys((1, 3), answer)


def test_a_function_that_says_for_itself_what_it_touches_takes_the_long_road():
    class Own(Request):
        code = 100

        class Reply(OpaqueReply):
            """Anything."""

        def spans(self) -> tuple[Span, ...]:
            return ()

    functions = FunctionTable(Own)
    assert permitted_answers(Policy.allow_all(), 1, functions, {100: answer}, audited=False) == {}
    assert permitted_answers(Policy.allow_all(), 1, functions, {99: answer}, audited=False) == {}
