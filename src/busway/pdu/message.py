"""Base classes of request and reply messages: fields are declared, encoder and decoder made from them once.

Knows how declared fields become bytes and back; knows no particular function, no transport and no device.

1. A subclass declares a code, perhaps a sub-code, and fields (`busway.pdu.fields`). Its constructor, ``encode``
   and ``decode`` are compiled when one of them is first used; nothing is interpreted per message.
2. An invalid message cannot be built: the constructor raises `InvalidRequest`. A received one that breaks a limit
   raises `MalformedPdu`, with the exception code that a server answers.
3. Messages are frozen. Payloads stay bytes in wire order.
4. What concerns the device (does an item exist?) is not a matter of the message: the range ``address + count``
   beyond 65 536 cannot be constructed, but is decoded, because a server answers it with 02 and not with 03.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn, Protocol, Self, TypeVar, dataclass_transform

from ..codes import Table
from ..values.counts import counted
from .compiler import Layout, attribute_names, compile_message
from .fields import Field, RestField, RestLength, repeated, rest, u8, u16
from .malformed_pdu import MalformedPdu

if TYPE_CHECKING:
    from .device_interface import Context, DataModel
    from .fast_answers import DirectModel, FastAnswer, PreparedAnswer

UNKNOWN_LENGTH = -1
"""Result of the length rules: the content of the message does not tell its length; the frame around it does."""
NEED_MORE = 0
"""Result of the length rules: more bytes are needed to tell the length."""


@dataclass(frozen=True, slots=True)
class Span:
    """A range of items in one table that a request reads or writes; access rules, hooks and routes check it.

    Attributes:
        table: the table.
        address: the first item, 0-based.
        count: number of items.
        writes: whether the items are written; otherwise they are read.
    """

    table: Table
    address: int
    count: int
    writes: bool


@dataclass(frozen=True, slots=True)
class Touch:
    """Declares which items the requests of a class read or write: the table, and the names of two of their fields.

    Attributes:
        table: the table.
        address: name of the request's field with the address of the first item.
        count: name of the request's field with the number of items; None if it is always one item.
    """

    table: Table
    address: str = "address"
    count: str | None = "count"


class _MessageType(type):
    """Metaclass of messages: turns a class body of field declarations into a slotted class with encoder and decoder."""

    def __new__(mcls, name: str, bases: tuple[type, ...], body: dict[str, Any], **options: Any) -> Any:
        declared = {key: value for key, value in body.items() if isinstance(value, Field)}
        for key in declared:
            del body[key]
        # Only declared fields become slots; a class that declares none inherits the fields of its base.
        slots = tuple(key for key, value in declared.items() if not isinstance(value, RestLength))
        body["__slots__"] = (*body.get("__slots__", ()), *slots)
        cls: Any = super().__new__(mcls, name, bases, body, **options)
        cls.has_rule = getattr(cls, "has_rule", False) or (bool(bases) and "validate" in body)
        cls.declared = {**getattr(cls, "declared", {}), **declared}
        if hasattr(cls, "direct"):
            _drop_outdated_shortcuts(cls, has_new_form=bool(declared) or "Reply" in body)
        if "code" in body:
            _complete(cls, body.get("Reply"))
        elif declared and body.get("self_coded", getattr(cls, "self_coded", False)):
            compile_message(cls)
        return cls


def _drop_outdated_shortcuts(cls: Any, *, has_new_form: bool) -> None:
    """Let a request class do without the shortcuts that it inherits, if they would pass over what it overrides.

    ``has_new_form``: whether its body declares fields or a reply class.
    """
    if _is_outdated(cls, "direct", "apply", "validate") or (has_new_form and "direct" not in vars(cls)):
        cls.direct = Request.direct
    if _is_outdated(cls, "prepared_answer", "apply", "validate", "direct"):
        cls.prepared_answer = Request.prepared_answer
    if _is_outdated(cls, "take", "accept", "check_reply", "Reply"):
        cls.take = cls.take_all = None


def _is_outdated(cls: Any, shortcut: str, *overridden: str) -> bool:
    """Whether a class or a base of it overrides one of some attributes, and inherits ``shortcut`` from behind that."""
    for each in cls.__mro__:
        own = vars(each)
        if shortcut in own:
            return False
        if not own.keys().isdisjoint(overridden):
            return True
    return False


def _complete(cls: Any, reply: Any) -> None:
    """Give a request class, and the reply class declared inside it, their function codes, layout and codecs."""
    if reply is None and cls.echoes:
        reply = _MessageType("Reply", (ReplyMessage,), {"__qualname__": f"{cls.__qualname__}.Reply", **cls.declared})
        reply.__module__ = cls.__module__
        reply.__doc__ = f"Repeats the fields of `{cls.__name__}`."
        reply.validate, reply.has_rule = cls.validate, cls.has_rule
        cls.Reply = reply
    elif reply is None and hasattr(cls, "Reply"):
        reply = _MessageType("Reply", (cls.Reply,), {"__qualname__": f"{cls.__qualname__}.Reply"})
        reply.__module__, reply.__doc__ = cls.__module__, cls.Reply.__doc__
        cls.Reply = reply
    if reply is not None:
        reply.code, reply.sub_code, reply.sub_width = cls.code, cls.sub_code, cls.sub_width
        compile_message(reply)
    compile_message(cls)
    if reply is not None and cls.check_reply is Request.check_reply and cls.accept is Request.accept:
        cls.take, cls.take_all = _takers_of(reply)


Reply_co = TypeVar("Reply_co", bound="Message", covariant=True)


@dataclass_transform(field_specifiers=(u8, u16, rest, repeated), frozen_default=True)
class Message(metaclass=_MessageType):
    """Base class of request and reply messages, which are immutable.

    A subclass declares a function code and fields (`busway.pdu.fields`); its constructor, ``encode`` and ``decode`` are
    made from them. The constructor takes the fields by position or name, and raises `InvalidRequest` for a value that
    is not allowed. Messages of one class are equal if their bytes are.
    """

    code: ClassVar[int]
    """Function code, 1…127; not set for classes with ``self_coded``."""
    sub_code: ClassVar[int | None] = None
    """Code after the function code: sub-function of 08 or MEI type of 43; None for functions without one."""
    sub_width: ClassVar[int] = 0
    """Bytes of the sub-code on the wire, 1 or 2; 0 without one."""
    self_coded: ClassVar[bool] = False
    """True if the function code is a field of the message, ``function``; False if the class sets it as ``code``."""
    exception_bit: ClassVar[bool] = False
    """Whether 0x80 is added to the function code on the wire: True for exception replies only."""
    has_rule: ClassVar[bool] = False
    """Whether the class or a base overrides `validate`, so that constructor and ``decode`` call it."""
    declared: ClassVar[dict[str, Field]] = {}
    layout: ClassVar[Layout]

    def validate(self) -> str | None:
        """Return which rule about several fields the message breaks, in words; None if it breaks none.

        Subclasses with such rules override it; constructor and ``decode`` turn a result into an error.
        """
        return None

    def encode(self) -> bytes:
        """Return the message as a PDU, function code first."""
        raise TypeError(f"{type(self).__name__} declares no code")

    @classmethod
    def decode(cls, pdu: bytes) -> Self:
        """Create the message from a whole PDU, function code first.

        Raises:
            MalformedPdu: the function code is another one, or a limit, a length or a rule of the class is broken.
        """
        raise TypeError(f"{cls.__name__} declares no code")

    @classmethod
    def wire_length(cls, data: bytes, at: int, end: int) -> int:
        """Return the length in bytes of the whole PDU of this class that starts at ``at``, from ``data[at:end]``.

        `NEED_MORE` if too few bytes are there to tell; `UNKNOWN_LENGTH` if the bytes of such a PDU never tell it.
        """
        layout = cls.layout
        if layout.length_at is not None:
            field = layout.fields[layout.length_at]
            assert isinstance(field, RestLength)
            first = at + layout.length_offset
            if end < first + field.width:
                return NEED_MORE
            counted = data[first] if field.width == 1 else data[first] << 8 | data[first + 1]
            return layout.length_offset + field.width + counted
        if layout.tail is not None:
            if isinstance(layout.tail, RestField) and layout.tail.low == layout.tail.high:
                return layout.head.size + layout.tail.low
            return UNKNOWN_LENGTH
        return layout.head.size

    def values(self) -> dict[str, Any]:
        """Return the values of the message's fields by name, in wire order, without byte counts."""
        return {name: getattr(self, name) for name in attribute_names(type(self))}

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self.encode() == other.encode()

    def __hash__(self) -> int:
        return hash((type(self), self.encode()))

    def __repr__(self) -> str:
        shown = ", ".join(
            f"{name}={value.hex(' ')!r}" if isinstance(value, bytes) else f"{name}={value!r}"
            for name, value in self.values().items()
        )
        return f"{type(self).__name__}({shown})"

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"{type(self).__name__} is frozen; build another one")

    def __delattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"{type(self).__name__} is frozen")

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, memo: object) -> Self:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (type(self), self.encode())


class SelfCoded(Message):
    """Base class of messages whose function code is a field, ``function``: exceptions, replies of unknown functions."""

    self_coded = True


class ReplyMessage(Message):
    """Base class of normal replies. A reply class is declared inside its request class, whose code it gets."""


class Request(Message):
    """Base class of requests: a subclass declares fields, limits and reply, and what the request does to a device.

    Class attributes that a subclass sets:
        Reply: class of its normal reply.
        reads, writes: the ranges of items that it reads and writes (`Touch`); None for none.
        is_write: whether executing it twice can differ from executing it once; then it is not repeated automatically.
            Always True if ``writes`` is set.
        echoes: whether the normal reply repeats the request; then no ``Reply`` is declared.
        broadcast: whether a serial master may send it to unit 0 (Serial Line V1.02 §2.1).
    """

    __slots__ = ("expected_prefix", "expected_size", "memo", "wire")
    Reply: ClassVar[type[ReplyMessage]]
    reads: ClassVar[Touch | None] = None
    writes: ClassVar[Touch | None] = None
    is_write: ClassVar[bool] = False
    echoes: ClassVar[bool] = False
    take: ClassVar[Any] = None  # Any: a staticmethod (bytes) -> Message or None; a plain callable would be bound
    """Function that creates a reply object from its data bytes alone, quicker than ``Reply.decode``.

    It checks nothing: the caller has compared length and first bytes of the PDU with the expected ones. None if the
    reply has more than a byte count and data, or there are further rules for it. Set when the class is created.
    """
    take_all: ClassVar[Any] = None  # Any: a staticmethod, as `take`
    """The same for the data of several replies: a third less time for each. None if ``take`` is None."""
    broadcast: ClassVar[bool] = False

    @classmethod
    def direct(cls, model: "DirectModel") -> "FastAnswer | None":
        """Return a function of the server's fast path that answers requests of this class from the memory of a device.

        None if requests of this class must take the generic path (`busway.pdu.fast_answers`): always, unless a subclass
        overrides this method.
        """
        return None

    if TYPE_CHECKING:  # slots that are filled later; declared so, they are no fields of the message

        @property
        def memo(self) -> Any:
            """Data of any type that a client session has stored with this request by `remember`.

            AttributeError if there are none.
            """

        @property
        def wire(self) -> bytes:
            """The request as an encoded PDU; AttributeError before `prepare`."""

        @property
        def expected_size(self) -> int:
            """Number of bytes of the expected reply PDU, or `UNKNOWN_LENGTH`; AttributeError before `prepare`."""

        @property
        def expected_prefix(self) -> bytes:
            """The bytes with which the expected reply PDU must begin; AttributeError before `prepare`."""

    @classmethod
    def prepared_answer(cls, model: "DirectModel", unit: int, pdu: bytes) -> "PreparedAnswer | None":
        """Return the prepared answer (`PreparedAnswer`) to a read of registers that a client repeats.

        None if the request does not read registers, or must take the generic path.

        Args:
            model: the device.
            unit: unit identifier of the request.
            pdu: the request PDU.
        """
        return None

    def apply(self, model: "DataModel", context: "Context") -> Message:
        """Execute the request on a device and return the normal reply. Subclasses override it.

        Args:
            model: the device.
            context: the client, the unit and its diagnostics.

        Raises:
            Refusal: the device refuses the request; has the exception code to reply.
            TypeError: the class does not override the method.
        """
        raise TypeError(f"{type(self).__name__} does not say what it does to a device")

    def spans(self) -> tuple[Span, ...]:
        """Return the ranges of items that the request reads and writes, the written one first; empty if it has none."""
        found = []
        for touch, writes in ((self.writes, True), (self.reads, False)):
            if touch is not None:
                count = 1 if touch.count is None else getattr(self, touch.count)
                found.append(Span(touch.table, getattr(self, touch.address), count, writes))
        return tuple(found)

    def reply_shape(self) -> tuple[int, bytes]:
        """Return length and first bytes of the expected normal reply PDU; a client recognises the reply by them.

        The length is in bytes, and `UNKNOWN_LENGTH` if it does not follow from the request.
        """
        if self.echoes:
            encoded = self.encode()
            return len(encoded), encoded
        layout = self.Reply.layout
        return layout.head.size if layout.tail is None else UNKNOWN_LENGTH, bytes((self.code,))

    def prepare(self) -> bytes:
        """Encode the request, store the result with it, and return the PDU.

        Afterwards the PDU can be read as ``wire``, and what is expected of the reply as ``expected_size`` and
        ``expected_prefix``. Calling it again does no harm.
        """
        wire = self.encode()
        size, prefix = self.reply_shape()
        _set_expected_size(self, size)
        _set_expected_prefix(self, prefix)
        _set_wire(self, wire)  # last: who finds it takes the request for prepared
        return wire

    def remember(self, memo: object) -> None:
        """Store data of a client session with this request, in place of earlier data; read it as ``memo``."""
        _set_memo(self, memo)

    def accept(self, pdu: bytes) -> Message:
        """Decode a normal reply PDU, check that it answers this request, and return it; call `prepare` before.

        Raises:
            MalformedPdu: the bytes are no valid reply of the function, or answer another request. An exception reply is
                refused too.
        """
        reply = self.Reply.decode(pdu)
        size, prefix = self.expected_size, self.expected_prefix
        if size != UNKNOWN_LENGTH and len(pdu) != size:
            raise MalformedPdu(f"{counted(len(pdu), 'byte')} where {size} answer the request")
        if not pdu.startswith(prefix):
            raise MalformedPdu(f"it begins {pdu[: len(prefix)].hex(' ')} where {prefix.hex(' ')} answers the request")
        problem = self.check_reply(reply)
        if problem is not None:
            raise MalformedPdu(problem)
        return reply

    def check_reply(self, reply: Any) -> str | None:
        """Return in words why a decoded reply, an object of ``Reply``, does not fit this request; None if it fits.

        Subclasses override it for what length and first bytes do not tell.
        """
        return None


class TypedRequest(Protocol[Reply_co]):
    """Interface of a request for type checkers, so that ``execute`` of a unit returns the type of its ``Reply``."""

    @property
    def Reply(self) -> type[Reply_co]:  # noqa: N802
        """The class of the normal reply to the request."""

    def encode(self) -> bytes:
        """Return the request as a PDU, function code first."""


def _rebuild(cls: type[Message], pdu: bytes) -> Message:
    # Not by the constructor: it refuses a range that ends beyond the table, which a received message may have.
    return cls.decode(pdu)


# Frozen messages are filled through their slots; bound once, because `prepare` is on the way of every new request.
_set_wire = Request.__dict__["wire"].__set__
_set_expected_size = Request.__dict__["expected_size"].__set__
_set_expected_prefix = Request.__dict__["expected_prefix"].__set__
_set_memo = Request.__dict__["memo"].__set__


def _takers_of(cls: Any) -> tuple[Any, Any]:  # staticmethods of (bytes) -> message and of (bytes of each) -> messages
    """Return functions that create one reply object, and several, from the data bytes alone.

    Both are None if the reply has other fields. The first takes 0.2 µs where ``decode`` takes 1.0, because it checks
    nothing: the caller has already compared length and first bytes of the PDU with the expected ones.
    """
    layout: Layout = cls.layout
    if len(layout.fields) != 1 or not isinstance(layout.fields[0], RestLength) or cls.has_rule:
        return None, None
    if not isinstance(layout.tail, RestField) or cls.sub_code is not None or layout.head.size != 2:
        return None, None
    new, put = cls.__new__, getattr(cls, layout.tail_name).__set__

    def take(data: bytes) -> Any:
        reply = new(cls)
        put(reply, data)
        return reply

    def take_all(data: Sequence[bytes]) -> list[Any]:
        replies = list(map(new, repeat(cls, len(data))))
        any(map(put, replies, data))  # a loop in C: `put` returns None
        return replies

    return staticmethod(take), staticmethod(take_all)
