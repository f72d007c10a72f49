"""Hooks: functions of the application that a device calls when Modbus reads or writes its tables.

Knows accesses and functions to call; knows no memory.

1. Hooks are for Modbus: reads and writes of the application itself call none.
2. A hook is called in the thread that executes the request, under ``Device.lock``. It must be short, and must not wait
   for a thread that may need the device.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Literal, TypeAlias

from ..codes import Table
from ..pdu.device_interface import Context


class When(Enum):
    """When a hook is called: before the access, which it may refuse, or after it."""

    BEFORE = "before"
    AFTER = "after"


Moment: TypeAlias = Literal["before", "after"]
"""The accepted texts for a `When`, for type checkers."""


@dataclass(frozen=True, slots=True)
class Access:
    """A read by Modbus, as a read hook gets it: client, unit, table, addresses and values.

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
    """A write by Modbus, as a write hook gets it: the old and new values and who wrote them.

    Attributes:
        peer: address of the client, ``host:port`` or the name of a serial line.
        unit: the unit identifier that was asked, 0…255.
        table: the table.
        address: first item, 0-based.
        count: number of items.
        old: what the items held before, ``int`` for registers, ``bool`` for bits.
        new: the values that the write sets.
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


ReadHook = Callable[[Access], object]
WriteHook = Callable[[Change], object]


@dataclass(frozen=True, slots=True)
class Hook:
    """A hook function, its table and address range: it is called for accesses that touch ``first``…``end - 1``."""

    function: Callable[..., object]
    table: Table
    when: When
    first: int
    end: int


class Hooks:
    """The read hooks or the write hooks of a device.

    A change replaces the whole tuple of hooks, so readers need no lock.
    """

    __slots__ = ("_all",)

    def __init__(self) -> None:
        self._all: tuple[Hook, ...] = ()

    def has_any(self, table: Table) -> bool:
        """Whether a table has hooks."""
        return any(hook.table is table for hook in self._all)

    def add(self, hook: Hook) -> None:
        """Add a hook; it is called after the existing ones."""
        self._all = (*self._all, hook)

    def remove(self, function: Callable[..., object]) -> bool:
        """Remove all hooks that call ``function``; returns whether there were any."""
        kept = tuple(hook for hook in self._all if hook.function != function)
        found = len(kept) < len(self._all)
        self._all = kept
        return found

    def wanted(self, table: Table, address: int, count: int) -> tuple[Hook, ...]:
        """Return the hooks to call for an access to this range of a table, in the order in which they were added."""
        if not self._all:
            return ()
        return tuple(
            hook for hook in self._all if hook.table is table and hook.first < address + count and address < hook.end
        )


def call(hooks: tuple[Hook, ...], when: When, access: Access | Change) -> None:
    """Call those of ``hooks`` that are registered for this moment, before or after the access, in order.

    If a hook raises an exception, the hooks after it are not called, and the exception is raised here.
    """
    for hook in hooks:
        if hook.when is when:
            hook.function(access)


def function_of(context: Context) -> int | None:
    """Return the function code of the request that a hook is called for; None if there is no request."""
    function = getattr(context, "function", None)
    return function if isinstance(function, int) else None


def role_of(context: Context) -> str | None:
    """Return the role of the client that a hook is called for; None if it has none."""
    role = getattr(context, "role", None)
    return role if isinstance(role, str) else None
