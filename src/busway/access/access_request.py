"""A request as an access policy sees it: client, unit, function, items and values.

Knows messages; knows no rule.

1. A request touches *pieces* (`TouchedRange`): ranges of items in a table, or of file numbers, or, if it touches
   neither, one piece without table or file. Each piece is read or written.
2. A request of unknown effect counts as a write: a function that is not in the table of functions, a user function that
   declares neither what it reads nor that it writes, a truncated sub-function. So do the sub-functions of 08 that
   change communication (01, 03, 04, 0A, 14), by their declarations.
3. A malformed request touches its whole tables: which items it means is not known, nor what a responder does with it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

from ..codes import FunctionCode, Table
from ..options.networks import host_of_peer
from ..pdu.file_records import ReadFileRecord, WriteFileRecord
from ..pdu.functions import AnyRequest
from ..pdu.malformed_request import MalformedRequest
from ..pdu.message import Request
from ..pdu.read_items import unpack_registers
from ..pdu.unknown_functions import OpaqueRequest
from ..pdu.write_items import MaskWriteRegister, ReadWriteMultipleRegisters, WriteMultipleRegisters, WriteSingleRegister

FILES: Final = "files"
"""The `Space` of file numbers; the other spaces are the four tables."""
Space = Table | str | None
"""What a request touches: a table, the files (`FILES`), or None for neither."""
END: Final = 1 << 32
"""An address after all that a request can name. Items after 65535 do not exist, but a request may name them."""

_SUB_WIDTH: Final[dict[int, int]] = {FunctionCode.DIAGNOSTICS: 2, FunctionCode.ENCAPSULATED_INTERFACE: 1}
_PUBLIC: Final = frozenset(int(code) for code in FunctionCode)
_OF_FILES: Final = (ReadFileRecord, WriteFileRecord)


@dataclass(slots=True)
class TouchedRange:
    """The items of a table, or the numbers of files, that a request reads or writes.

    Attributes:
        space: a table, `FILES`, or None if the request touches neither.
        first, end: the range of offsets or file numbers: from ``first`` to ``end - 1``; 0 and 1 if ``space`` is None.
        writes: whether the range is written; else it is read.
    """

    space: Space
    first: int
    end: int
    writes: bool


@dataclass(frozen=True, slots=True)
class AccessSubject:
    """The client of a request as access rules see it: its host, its role and the listener it uses.

    Attributes:
        host: numeric address, ``10.0.0.7``; the name of a serial line.
        role: role of the client's certificate; None without one.
        listener: URL of the listener.
        listener_names: further URLs that a rule may use for the listener.
    """

    host: str = ""
    role: str | None = None
    listener: str = ""
    listener_names: tuple[str, ...] = ()


@dataclass(slots=True)
class AccessRequest:
    """One request with all facts that an access policy decides by. Created with ``of``.

    Attributes:
        subject: the client.
        unit: the unit asked, 0…255.
        listed: the units under which its device is configured: a device may have several, and a sole device also
            answers to units 0 and 255. Empty: ``unit`` alone.
        function: the function code.
        sub_function: the sub-function of 08 and 43; None for other functions, and if it is truncated.
        pieces: the ranges of items or files that the request touches; at least one (rule 1 of this file).
        written: the values of the registers that the request would write, in the order of the written range; None if it
            writes no registers, or if the values are unknown.
        masks: AND mask and OR mask of function 22, whose result depends on the current value; None for other functions.
    """

    subject: AccessSubject
    unit: int
    function: int
    sub_function: int | None
    pieces: tuple[TouchedRange, ...]
    written: tuple[int, ...] | None = None
    masks: tuple[int, int] | None = None
    listed: frozenset[int] = frozenset()

    @classmethod
    def of(
        cls,
        request: AnyRequest,
        *,
        unit: int,
        listed: frozenset[int] = frozenset(),
        peer: str = "",
        role: str | None = None,
        listener: str = "",
        subject: AccessSubject | None = None,
    ) -> "AccessRequest":
        """Return the facts of a decoded request that a policy decides on.

        Args:
            request: the decoded request.
            unit: the unit asked, 0…255.
            listed: the units under which its device is configured; empty: ``unit`` alone.
            peer: ``host:port`` or host of the client.
            role: role of the client's certificate; None without one.
            listener: URL of the listener.
            subject: the client; if given, ``peer``, ``role`` and ``listener`` are ignored.
        """
        subject = subject or AccessSubject(host_of_peer(peer), role, listener)
        if isinstance(request, MalformedRequest):
            sub_function = _sub_function(request.function, request.data[1:])
            pieces = _pieces_of_malformed(request, sub_function)
            return cls(subject, unit, request.function, sub_function, pieces, listed=listed)
        if isinstance(request, OpaqueRequest):
            sub_function = _sub_function(request.function, request.data)
            return cls(subject, unit, request.function, sub_function, _UNKNOWN_WRITE, listed=listed)
        masks = (request.and_mask, request.or_mask) if isinstance(request, MaskWriteRegister) else None
        written = _WRITTEN.get(type(request))
        return cls(
            subject,
            unit,
            request.code,
            request.sub_code,
            _pieces(request),
            None if written is None else written(request),
            masks,
            listed,
        )

    @property
    def writes(self) -> bool:
        """Whether the access rules treat the request as a write."""
        return any(piece.writes for piece in self.pieces)

    def with_current(self, current: int) -> "AccessRequest":
        """Return a copy of a mask write (function 22) with the value it would write if the register holds ``current``.

        The copy has this value in ``written``, and None in ``masks``. Other requests are returned unchanged.
        """
        if self.masks is None:
            return self
        and_mask, or_mask = self.masks
        return replace(self, written=(masked(current, and_mask, or_mask),), masks=None)


def masked(current: int, and_mask: int, or_mask: int) -> int:
    """Return the value that a mask write (function 22) gives a register that holds ``current``; all are 0…65535.

    Application Protocol V1.1b3 §6.16.
    """
    return (current & and_mask | or_mask & ~and_mask) & 0xFFFF


def counts_as_write(kind: type[Request]) -> bool:
    """Whether a function counts as a write, by its declaration; a function of unknown effect counts as one (rule 2)."""
    if kind.is_write or kind.writes is not None:
        return True
    return kind.code not in _PUBLIC and kind.reads is None


def _pieces(request: Request) -> tuple[TouchedRange, ...]:
    found = [
        TouchedRange(span.table, span.address, span.address + (span.count or 1), span.writes)
        for span in request.spans()
    ]
    if isinstance(request, _OF_FILES):
        writes = isinstance(request, WriteFileRecord)
        found += [TouchedRange(FILES, group.file, group.file + 1, writes) for group in request.groups]
    return _with_unknown_effect(found, type(request))


def _with_unknown_effect(found: list[TouchedRange], kind: type[Request]) -> tuple[TouchedRange, ...]:
    """Return the pieces of a request, and one with ``space`` None if it has none, or none that shows that it writes."""
    if not any(piece.writes for piece in found):
        writes = counts_as_write(kind)
        if writes or not found:
            found.append(TouchedRange(None, 0, 1, writes))
    return tuple(found)


def _pieces_of_malformed(request: MalformedRequest, sub_function: int | None) -> tuple[TouchedRange, ...]:
    kind = request.kind
    return _UNKNOWN_WRITE if kind.sub_code is not None and sub_function is None else touched_by(kind)


def touched_by(kind: type[Request]) -> tuple[TouchedRange, ...]:
    """Return all that requests of a function could touch: whole tables, or all files, each either read or written.

    A function that touches neither has one piece with ``space`` None, and so has one that counts as a write but
    declares none; the result is never empty.
    """
    if issubclass(kind, _OF_FILES):
        return (TouchedRange(FILES, 0, END, issubclass(kind, WriteFileRecord)),)
    found = [
        TouchedRange(touch.table, 0, END, writes)
        for touch, writes in ((kind.writes, True), (kind.reads, False))
        if touch is not None
    ]
    return _with_unknown_effect(found, kind)


def _sub_function(function: int, data: bytes) -> int | None:
    """Return the sub-function at the start of a request's data; None if it is cut off, or the function has none."""
    width = _SUB_WIDTH.get(function)
    return int.from_bytes(data[:width], "big") if width is not None and len(data) >= width else None


def _registers(request: Any) -> tuple[int, ...]:  # any request with registers as ``data``
    return tuple(unpack_registers(request.data))


_WRITTEN: Final[dict[type, Callable[[Any], tuple[int, ...]]]] = {
    WriteSingleRegister: lambda request: (request.value,),
    WriteMultipleRegisters: _registers,
    ReadWriteMultipleRegisters: _registers,
}
"""By request class, a function that returns the values of the holding registers written; other writes are not here."""
_UNKNOWN_WRITE: Final = (TouchedRange(None, 0, 1, True),)
