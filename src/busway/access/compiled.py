"""Access checks of the compiled path: a policy compiled into the answers that a set of rights may use.

Knows declarations of functions and where address and count are in a request; knows no handler.

1. An answer that is permitted everywhere is offered unchanged; one that is permitted in some address ranges gets one
   check before it; one with value limits gets a block that checks what is written (`busway.access.writes`). Answers
   under a rate, and requests that are not one plain range, are not offered and take the generic path.
2. A request that fails the check takes the generic path, and is decided, counted and logged there. So the compiled
   path permits only what the generic path permits (a property test compares them).
"""

import struct
from bisect import bisect_right
from collections.abc import Mapping, Sequence

from ..pdu.direct import Answer, DeviceAnswers
from ..pdu.fields import FixedField
from ..pdu.functions import FunctionTable
from ..pdu.message import Request, Touch
from .question import counts_as_write
from .rules import Policy, Window, Zone, zones_of
from .writes import LOOKED_AT, NotedWrites, looking_answer

_unpack_address = struct.Struct(">H").unpack_from
_unpack_two = struct.Struct(">HH").unpack_from


def permitted_answers(
    policy: Policy,
    unit: int,
    functions: FunctionTable,
    answers: Mapping[int, Answer],
    *,
    audited: bool,
    listed: int | None = None,
) -> dict[int, Answer]:
    """The compiled answers of a handler that a policy permits; equal for clients with equal rights.

    Args:
        policy: the rules that apply to the client (`Policy.for_asker`).
        unit: the unit asked, 0…255.
        functions: the functions that the handler decodes.
        answers: the compiled answers of the handler, by function code.
        audited: whether every write is recorded, so that none may take this path.
        listed: the unit under which the device is configured, if another one.
    """
    policy = _about_unit(policy, unit, listed)
    found = {}
    for code, answer in answers.items():
        kind = functions.find(bytes((code,)), 0, 1)
        if kind is None or (audited and counts_as_write(kind)):
            continue
        permitted = _permitted(policy, unit, listed, kind, answer)
        if permitted is not answer and isinstance(answers, DeviceAnswers) and kind in LOOKED_AT:
            zones = _zones(policy, unit, listed, kind)
            if any(zone.limits is not None for zone in zones):
                permitted = looking_answer(kind, answers.model, zones)
        if permitted is not None:
            found[code] = permitted
    return found


def noted_writes(
    policy: Policy, unit: int, functions: FunctionTable, answers: Mapping[int, Answer], *, listed: int | None = None
) -> NotedWrites | None:
    """The writes that may take the compiled path although each is recorded in the audit log; None without any.

    The arguments are those of `permitted_answers`.
    """
    if not isinstance(answers, DeviceAnswers):
        return None
    policy = _about_unit(policy, unit, listed)
    found = {}
    for code in answers:
        kind = functions.find(bytes((code,)), 0, 1)
        if kind in LOOKED_AT:
            zones = _zones(policy, unit, listed, kind)
            if zones:
                found[code] = kind, zones
    return NotedWrites(answers.model, found) if found else None


def _about_unit(policy: Policy, unit: int, listed: int | None) -> Policy:
    """The policy with only the rules about a unit: of many thousand rules, looked at once and not for each function."""
    rules = tuple(rule for rule in policy.rules if rule.units is None or unit in rule.units or listed in rule.units)
    return policy if len(rules) == len(policy.rules) else Policy(rules, policy.default)


def _zones(policy: Policy, unit: int, listed: int | None, kind: type[Request]) -> tuple[Zone, ...]:
    assert kind.writes is not None  # or it would not be among those `LOOKED_AT`
    return zones_of(policy, unit, kind.code, kind.writes.table, listed=listed)


def _permitted(policy: Policy, unit: int, listed: int | None, kind: type[Request], answer: Answer) -> Answer | None:
    if kind.spans is not Request.spans:
        return None  # it says for itself what it touches: only a request can tell
    touches = [(touch, writes) for touch, writes in ((kind.writes, True), (kind.reads, False)) if touch is not None]
    nowhere = not touches or (counts_as_write(kind) and kind.writes is None)
    if nowhere and not policy.windows(unit, kind.code, None, writes=counts_as_write(kind), listed=listed)[1]:
        return None
    found = [policy.windows(unit, kind.code, touch.table, writes=writes, listed=listed) for touch, writes in touches]
    if all(everywhere for _, everywhere in found):
        return answer
    if len(found) != 1 or not found[0][0] or not _is_plain(kind, touches[0][0]):
        return None
    windows = found[0][0]
    if touches[0][0].count is None:
        return _single(answer, windows)
    return _one_window(answer, windows[0]) if len(windows) == 1 else _several_windows(answer, windows)


def _is_plain(kind: type[Request], touch: Touch) -> bool:
    """Whether the request begins with the address and, if it has one, the count of what it touches."""
    names = ("address",) if touch.count is None else ("address", "count")
    fields = kind.layout.fields[: len(names)]
    return (
        kind.sub_code is None
        and (touch.address, touch.count or "count") == ("address", "count")
        and tuple(kind.layout.names[: len(names)]) == names
        and all(isinstance(field, FixedField) and field.width == 2 for field in fields)
    )


def _one_window(answer: Answer, window: Window) -> Answer:
    first, last = window.first, window.end

    def within(buffer: bytes | bytearray, at: int, end: int) -> bytes | None:
        try:  # what is cut off reaches into the next frame, or beyond the buffer; the answer judges the length
            address, count = _unpack_two(buffer, at + 1)
        except struct.error:
            return None
        return answer(buffer, at, end) if first <= address <= last - count else None

    return within


def _several_windows(answer: Answer, windows: Sequence[Window]) -> Answer:
    firsts = [window.first for window in windows]
    ends = [window.end for window in windows]

    def within(buffer: bytes | bytearray, at: int, end: int) -> bytes | None:
        try:
            address, count = _unpack_two(buffer, at + 1)
        except struct.error:
            return None
        index = bisect_right(firsts, address) - 1
        return answer(buffer, at, end) if index >= 0 and address <= ends[index] - count else None

    return within


def _single(answer: Answer, windows: Sequence[Window]) -> Answer:
    """An answer with a check of the address before it, for functions that touch one item and have no count."""
    firsts = [window.first for window in windows]
    ends = [window.end for window in windows]

    def within(buffer: bytes | bytearray, at: int, end: int) -> bytes | None:
        try:
            (address,) = _unpack_address(buffer, at + 1)
        except struct.error:
            return None
        index = bisect_right(firsts, address) - 1
        return answer(buffer, at, end) if index >= 0 and address < ends[index] else None

    return within
