"""One line of the audit log: a request and its outcome as JSON.

Knows requests and their outcome; writes nothing. Lines are formatted by hand from prepared parts, because a plant may
write thousands of times a second. For writes on the fast path (`busway.access.fast_path_rights`) all but time, address
and items is prepared.

===============  ===========================================================================================
key              value
===============  ===========================================================================================
``time``         when the request was denied or answered, UTC: ``2026-03-01T12:00:00.250Z``
``peer``         ``host:port`` of the client, or the name of a serial line
``role``         role of the client's certificate; null without one
``listener``     URL of the listener
``unit``         0…255
``function``     function code; ``sub_function`` beside it for 08 and 43
``address``      first item, 0-based, of function 23 the first one written; null if the request touches no table
``count``        number of items, for files of registers; null if the request touches neither items nor files
``old``          items before a write that was executed; null if they are not known
``new``          items that were, or would have been, written; null if they are not known
``outcome``      ``done``, ``exception`` (the device refused), ``denied`` (by a rule), ``no answer``
``code``         exception code; null without one
``rule``         name of the rule that decided; ``default`` if no rule applied
``repeated``     number of equal denials (same host, role and rule) since their last line; this line shows the latest of
                 them. Absent if the line is about one denial alone
===============  ===========================================================================================

Some functions have further keys: ``masks`` of function 22, ``records`` (``[file, record, count]``) of 20 and 21,
``data`` (hexadecimal) of requests without known items.
"""

from collections.abc import Callable, Sequence
from json.encoder import encode_basestring_ascii as quoted
from typing import Any, Final

from ..pdu.exception_response import ExceptionResponse
from ..pdu.fast_answers import Requester
from ..pdu.file_records import FileData, FileReference, ReadFileRecord, WriteFileRecord
from ..pdu.functions import AnyRequest
from ..pdu.malformed_request import MalformedRequest
from ..pdu.message import Message, Request
from ..pdu.read_items import unpack_registers
from ..pdu.unknown_functions import OpaqueRequest
from ..pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)
from ..session.responder import Deferral, Replaced, RequestContext
from .access_request import masked

DENIED: Final = "denied"
NO_ANSWER: Final = "no answer"
_NULL: Final = "null"


def who_text(client: Requester) -> str:
    """Return the JSON members that all audit lines of one client share: ``"peer":…,"role":…,"listener":…``, no braces.

    Also stores the text in ``client.audit_text``, for the next line.
    """
    role = _NULL if client.role is None else quoted(client.role)
    client.audit_text = f'"peer":{quoted(client.peer)},"role":{role},"listener":{quoted(client.listener)}'
    return client.audit_text


def audit_line(
    context: RequestContext, request: AnyRequest, when: str, outcome: str, code: int | None, repeated: int = 0
) -> str:
    """Return the audit line of one request: a JSON object and a line feed, in ASCII. It is not written to a log.

    Args:
        context: the request's circumstances; ``context.judged`` must be set.
        request: the decoded request.
        when: the time as text.
        outcome: ``done``, ``exception``, ``denied`` or ``no answer``.
        code: exception code of the reply; None without one.
        repeated: how many equal denials the line stands for; 0 if it is about this request alone.
    """
    judged = context.judged
    assert judged is not None  # or there would be no line
    what, old, new = _facts(request, None if outcome == DENIED else judged.replaced)
    so_often = f',"repeated":{repeated}' if repeated else ""
    who = context.client.audit_text or who_text(context.client)
    return (
        f'{{"time":"{when}",{who},"unit":{context.unit},{what},"old":{old},"new":{new},'
        f'"outcome":"{outcome}","code":{_NULL if code is None else code},"rule":{quoted(judged.rule)}{so_often}}}\n'
    )


def done_line(unit: int, function: int, rule: str) -> tuple[str, str]:
    """Return the prepared parts of an executed write's audit line: the text behind the client, and the line's end.

    The caller composes the line: ``{"time":"…",`` and the client's part (`who_text`), the first text, address and items
    (by the function in `DONE` for the request's class), the second text. It then equals that of `audit_line`, to the
    byte.
    """
    return (
        f',"unit":{unit},"function":{function:d},"address":',
        f',"outcome":"done","code":{_NULL},"rule":{quoted(rule)}}}\n',
    )


def _done_bit(address: int, count: int, old: bytes, new: bytes) -> str:
    return f'{address},"count":1,"old":[{old[0]}],"new":[{new[0]}]'


def _done_register(address: int, count: int, old: bytes, new: bytes) -> str:
    return f'{address},"count":1,"old":[{old[0] << 8 | old[1]}],"new":[{new[0] << 8 | new[1]}]'


def _done_registers(address: int, count: int, old: bytes, new: bytes) -> str:
    return f'{address},"count":{count},"old":{_registers(old)},"new":{_registers(new)}'


def _done_bits(address: int, count: int, old: bytes, new: bytes) -> str:
    return f'{address},"count":{count},"old":{_bits(old, count)},"new":{_bits(new, count)}'


Done = Callable[[int, int, bytes, bytes], str]
DONE: Final[dict[type[Request], Done]] = {
    WriteSingleCoil: _done_bit,
    WriteSingleRegister: _done_register,
    WriteMultipleCoils: _done_bits,
    WriteMultipleRegisters: _done_registers,
}
"""By request class, a function that formats the items of an executed write, for functions that only write one range.

It takes address, count, old and new items in wire order, and returns the JSON text from the address on.
"""


def outcome_of(reply: Message | Deferral | None) -> tuple[str, int | None]:
    """Return outcome (``done``, ``exception`` or ``no answer``) and exception code of a request for its audit line.

    ``reply`` is the reply to the request. Its code is None unless the outcome is ``exception``. If ``reply`` is None or
    a `Deferral`, the outcome is ``no answer``. The outcome ``denied`` is not found here.
    """
    if isinstance(reply, ExceptionResponse):
        return "exception", int(reply.exception)
    return ("done", None) if isinstance(reply, Message) else (NO_ANSWER, None)


def _facts(request: AnyRequest, replaced: Replaced | None) -> tuple[str, str, str]:
    """Return three pieces of a request's audit line, as JSON.

    The first has the members ``"function":…,"address":…,"count":…`` and those of the function, without braces. The
    second and third are the old and the new values as lists, or ``null`` where they are unknown or there are none.
    ``replaced`` has the old values; None if unknown.
    """
    if isinstance(request, ReadFileRecord | WriteFileRecord):
        return _file_facts(request, replaced)
    facts = _FACTS.get(type(request), _other_facts)
    return facts(request, replaced[0] if replaced else None)


def _register_facts(request: WriteSingleRegister, before: bytes | None) -> tuple[str, str, str]:
    return f'"function":6,"address":{request.address},"count":1', _registers(before), f"[{request.value}]"


def _registers_facts(request: WriteMultipleRegisters, before: bytes | None) -> tuple[str, str, str]:
    what = f'"function":16,"address":{request.address},"count":{request.count}'
    return what, _registers(before), _registers(request.data)


def _both_ways_facts(request: ReadWriteMultipleRegisters, before: bytes | None) -> tuple[str, str, str]:
    what = f'"function":23,"address":{request.write_address},"count":{request.write_count}'
    return what, _registers(before), _registers(request.data)


def _mask_facts(request: MaskWriteRegister, before: bytes | None) -> tuple[str, str, str]:
    masks = request.and_mask, request.or_mask
    new = _NULL if before is None else f"[{masked(int.from_bytes(before, 'big'), *masks)}]"
    what = f'"function":22,"address":{request.address},"count":1,"masks":[{masks[0]}, {masks[1]}]'
    return what, _registers(before), new


def _coil_facts(request: WriteSingleCoil, before: bytes | None) -> tuple[str, str, str]:
    what = f'"function":5,"address":{request.address},"count":1'
    return what, _bits(before, 1), "[1]" if request.value else "[0]"


def _coils_facts(request: WriteMultipleCoils, before: bytes | None) -> tuple[str, str, str]:
    what = f'"function":15,"address":{request.address},"count":{request.count}'
    return what, _bits(before, request.count), _bits(request.data, request.count)


def _file_facts(request: ReadFileRecord | WriteFileRecord, replaced: Replaced | None) -> tuple[str, str, str]:
    """Return the three pieces of `_facts` for functions 20 and 21, with all groups of file records."""
    groups: Sequence[FileReference | FileData] = request.groups
    records = [[group.file, group.record, group.count] for group in groups]
    count = sum(group.count for group in groups)
    what = f'"function":{request.code:d},"address":null,"count":{count},"records":{records}'
    if isinstance(request, ReadFileRecord):
        return what, _NULL, _NULL
    known = [data for data in replaced or () if data is not None]
    old = _registers(b"".join(known)) if known and len(known) == len(groups) else _NULL
    return what, old, _registers(b"".join(group.data for group in request.groups))


def _unread_facts(request: OpaqueRequest | MalformedRequest, before: bytes | None) -> tuple[str, str, str]:
    data = request.encode()[1:]
    return f'"function":{request.function},"address":null,"count":null,"data":"{data.hex()}"', _NULL, _NULL


def _other_facts(request: Request, before: bytes | None) -> tuple[str, str, str]:
    """Return the three pieces of `_facts` for reads, requests without a table, and the user's functions."""
    spans = request.spans()
    span = next((span for span in spans if span.writes), spans[0] if spans else None)
    what = f'"function":{request.code:d}'
    if request.sub_code is not None:
        what += f',"sub_function":{request.sub_code:d}'
    if span is None:
        body = request.encode()[1 + request.sub_width :]
        return f'{what},"address":null,"count":null,"data":"{body.hex()}"', _NULL, _NULL
    old = _bits(before, span.count) if span.table.holds_bits else _registers(before)
    return f'{what},"address":{span.address},"count":{span.count}', old, _NULL


_FACTS: Final[dict[type, Callable[[Any, Any], tuple[str, str, str]]]] = {  # Any: each takes what its key says
    WriteSingleCoil: _coil_facts,
    WriteSingleRegister: _register_facts,
    WriteMultipleCoils: _coils_facts,
    WriteMultipleRegisters: _registers_facts,
    MaskWriteRegister: _mask_facts,
    ReadWriteMultipleRegisters: _both_ways_facts,
    OpaqueRequest: _unread_facts,
    MalformedRequest: _unread_facts,
}


def _registers(data: bytes | None) -> str:
    return _NULL if data is None else str(unpack_registers(data))


def _bits(data: bytes | None, count: int) -> str:
    if data is None:
        return _NULL
    above = 1 << min(count, 8 * len(data))  # keeps the zeros below it
    digits = f"{int.from_bytes(data, 'little') & above - 1 | above:b}"
    return f"[{', '.join(digits[:0:-1])}]"
