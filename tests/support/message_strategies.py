"""Messages of every class, made up by hypothesis from the declarations of the class itself.

Fields come from `Message.declared`; what a function says across fields (`validate`) is put right in `_FITTING`.
"""

from collections.abc import Callable
from typing import Any

from hypothesis import strategies as st

from busway.codes import MAX_FIFO_REGISTERS, PDU_LIMIT, TABLE_SIZE
from busway.pdu.diagnostics import Diagnostic
from busway.pdu.encapsulated import IdentificationObject, ReadDeviceIdentification
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.fields import Field, FixedField, RepeatedField, RestField, RestLength
from busway.pdu.file_records import FileContent, FileData, FileReference
from busway.pdu.functions import STANDARD
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadFifoQueue
from busway.pdu.unknown_functions import OpaqueReply, OpaqueRequest

REQUESTS: tuple[type[Request], ...] = tuple(STANDARD)
REPLIES: tuple[type[Message], ...] = tuple(one.Reply for one in STANDARD)
GENERAL: tuple[type[Message], ...] = (ExceptionResponse, OpaqueRequest, OpaqueReply)
ALL: tuple[type[Message], ...] = (*REQUESTS, *REPLIES, *GENERAL)

_WORD = st.integers(0, 0xFFFF)
_ITEMS: dict[type[Any], st.SearchStrategy[Any]] = {
    FileReference: st.builds(FileReference, file=_WORD, record=_WORD, count=st.integers(0, 40)),
    FileData: st.builds(
        FileData, file=_WORD, record=_WORD, data=st.binary(max_size=80).map(lambda data: data[: len(data) & ~1])
    ),
    FileContent: st.builds(FileContent, data=st.binary(max_size=80).map(lambda data: data[: len(data) & ~1])),
    IdentificationObject: st.builds(IdentificationObject, number=st.integers(0, 255), value=st.binary(max_size=100)),
}


def name_of(kind: type[Message]) -> str:
    """A readable test id."""
    return kind.__qualname__


def fields_of(kind: type[Message]) -> st.SearchStrategy[dict[str, Any]]:
    """Values for the constructor of ``kind`` that it takes."""
    drawn = st.fixed_dictionaries(
        {name: _values(field) for name, field in kind.declared.items() if not isinstance(field, RestLength)}
    )
    return drawn.map(lambda values: _fit(kind, values))


def messages(kind: type[Message]) -> st.SearchStrategy[Message]:
    """Messages of one class, the smallest and the largest among them."""
    return fields_of(kind).map(lambda values: kind(**values))


def any_request() -> st.SearchStrategy[Request]:
    """A request of any function of the table."""
    return st.one_of([messages(kind) for kind in REQUESTS])  # type: ignore[return-value]


def _values(field: Field) -> st.SearchStrategy[Any]:
    if isinstance(field, FixedField):
        if field.values is not None:
            return st.sampled_from(field.values)
        return st.one_of(st.sampled_from((field.low, field.high)), st.integers(field.low, field.high))
    if isinstance(field, RestField):
        sizes = st.integers(-(-field.low // field.step), field.high // field.step).map(lambda size: size * field.step)
        return sizes.flatmap(lambda size: st.binary(min_size=size, max_size=size))
    assert isinstance(field, RepeatedField)
    return st.lists(_ITEMS[field.item], min_size=field.low, max_size=min(field.high, 6)).map(tuple)


def _fit(kind: type[Message], values: dict[str, Any]) -> dict[str, Any]:
    for touch in (getattr(kind, "reads", None), getattr(kind, "writes", None)):
        if touch is not None:
            count = 1 if touch.count is None else values[touch.count]
            values[touch.address] = min(values[touch.address], TABLE_SIZE - count)
    for one in kind.__mro__:
        if one in _FITTING:
            _FITTING[one](kind, values)
    tail = kind.layout.tail
    if isinstance(tail, RepeatedField):
        while kind.layout.head.size + sum(len(item.encode()) for item in values[kind.layout.tail_name]) > PDU_LIMIT:
            values[kind.layout.tail_name] = values[kind.layout.tail_name][1:]
        for one in kind.__mro__:
            if one in _FITTING:
                _FITTING[one](kind, values)
    return values


def _sized(count: str, bytes_of: Callable[[int], int]) -> Callable[[Any, dict[str, Any]], None]:
    def fit(kind: Any, values: dict[str, Any]) -> None:
        size = bytes_of(values[count])
        values["data"] = (values["data"] * (size // len(values["data"]) + 1))[:size]

    return fit


def _diagnostic(kind: Any, values: dict[str, Any]) -> None:
    if kind.allowed:
        values["data"] = kind.allowed[values["data"][0] % len(kind.allowed)]
    else:
        values["data"] = bytes((values["data"][0] & 0x7F, 0))


def _fifo(kind: Any, values: dict[str, Any]) -> None:
    values["data"] = values["data"][: 2 * MAX_FIFO_REGISTERS]
    values["count"] = len(values["data"]) // 2


def _announced(kind: Any, values: dict[str, Any]) -> None:
    values["number_of_objects"] = len(values["objects"])


def _readable(kind: Any, values: dict[str, Any]) -> None:
    groups = values["groups"]
    while sum(2 + 2 * group.count for group in groups) > PDU_LIMIT - 2:
        groups = groups[1:]
    values["groups"] = groups


def _written(kind: Any, values: dict[str, Any]) -> None:
    if not any(group.data for group in values["groups"]):
        values["groups"] = (FileData(1, 1, b"\x00\x01"),)


_FUNCTIONS = {one.__name__: one for one in STANDARD}
_FITTING: dict[type, Callable[[Any, dict[str, Any]], None]] = {
    _FUNCTIONS["WriteMultipleCoils"]: _sized("count", lambda count: (count + 7) // 8),
    _FUNCTIONS["WriteMultipleRegisters"]: _sized("count", lambda count: 2 * count),
    _FUNCTIONS["ReadWriteMultipleRegisters"]: _sized("write_count", lambda count: 2 * count),
    _FUNCTIONS["ReadFileRecord"]: _readable,
    _FUNCTIONS["WriteFileRecord"]: _written,
    _FUNCTIONS["WriteFileRecord"].Reply: _written,
    ReadFifoQueue.Reply: _fifo,
    ReadDeviceIdentification.Reply: _announced,
    Diagnostic: _diagnostic,
}
