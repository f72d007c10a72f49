"""What an application hangs on the accesses that come by Modbus, and what it learns of them.

Knows accesses and functions to call; knows no store.

1. Hooks are for Modbus: what the application itself reads and writes calls none.
2. A hook is called in the thread that executes the request, under ``Device.lock``. It is short, and waits for no other
   thread that may want the device.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from ..codes import Table
from ..pdu.model import Context


class When(Enum):
    """Whether a hook comes before the access, and may refuse it, or after."""

    BEFORE = "before"
    AFTER = "after"


@dataclass(frozen=True, slots=True)
class Access:
    """A read by Modbus.

    Attributes:
        peer: address of the client, ``host:port`` or the name of a serial line.
        unit: the unit identifier that was asked, 0…255.
        table: the table.
        address: first item, 0-based.
        count: number of items.
        values: what was read, ``int`` for registers, ``bool`` for bits; empty before the read.
        function: function code of the request; None if it is not known. 22 and 23 read and write in one request.
        role: role of the client's certificate; None without one.
    """

    peer: str
    unit: int
    table: Table
    address: int
    count: int
    values: list[int]
    function: int | None = None
    role: str | None = None


@dataclass(frozen=True, slots=True)
class Change:
    """A write by Modbus.

    Attributes:
        peer: address of the client, ``host:port`` or the name of a serial line.
        unit: the unit identifier that was asked, 0…255.
        table: the table.
        address: first item, 0-based.
        count: number of items.
        old: what the items held before, ``int`` for registers, ``bool`` for bits.
        new: what they are to hold.
        function: function code of the request; None if it is not known. 22 and 23 read and write in one request.
        role: role of the client's certificate; None without one.
    """

    peer: str
    unit: int
    table: Table
    address: int
    count: int
    old: list[int]
    new: list[int]
    function: int | None = None
    role: str | None = None


ReadFunction = Callable[[Access], object]
WriteFunction = Callable[[Change], object]


@dataclass(frozen=True, slots=True)
class Hook:
    """A function, and the accesses that it is called for: those that touch ``first``…``end - 1``."""

    function: Callable[..., object]
    when: When
    first: int
    end: int


class Hooks:
    """The hooks of one table and one direction. Replaced whole when one comes or goes, so that none is half there."""

    __slots__ = ("_all",)

    def __init__(self) -> None:
        self._all: tuple[Hook, ...] = ()

    def __bool__(self) -> bool:
        return bool(self._all)

    def add(self, hook: Hook) -> None:
        """One more, called after those that were there."""
        self._all = (*self._all, hook)

    def remove(self, function: Callable[..., object]) -> bool:
        """All that call ``function``; whether there were any."""
        kept = tuple(hook for hook in self._all if hook.function != function)
        found = len(kept) < len(self._all)
        self._all = kept
        return found

    def wanted(self, address: int, count: int) -> tuple[Hook, ...]:
        """Those that an access to a range calls, in the order in which they were added."""
        if not self._all:
            return ()
        return tuple(hook for hook in self._all if hook.first < address + count and address < hook.end)


def call(hooks: tuple[Hook, ...], when: When, access: Access | Change) -> None:
    """Call those of ``hooks`` that are for this moment; what one raises ends it."""
    for hook in hooks:
        if hook.when is when:
            hook.function(access)


def function_of(context: Context) -> int | None:
    """The function code of the request, if whoever asks tells it."""
    function = getattr(context, "function", None)
    return function if isinstance(function, int) else None


def role_of(context: Context) -> str | None:
    """The role of the client, if whoever asks tells it."""
    role = getattr(context, "role", None)
    return role if isinstance(role, str) else None
