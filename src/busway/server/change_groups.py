"""Groups of changes that an application makes to a device and that become visible together.

Knows runs and the lock; knows no table, no hook and no request.

1. A group never holds the lock while the application works in it: it keeps a journal of its changes. When the group
   ends, the journal is applied to fresh copies of the runs' bytes. So a Modbus write that came meanwhile is not lost,
   and no request waits for longer than the copying takes.
2. Where the group and a Modbus write have changed the same item, the group's value remains, as if the Modbus write had
   come just before. A value that depends on its own old value (a counter) is changed under ``Device.lock``.
3. Inside the group, its own thread or task sees what the runs held when the group first touched them, with the group's
   changes. No other thread or request sees a change of the group before the group ends.
4. A group that ends with an exception changes nothing.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from .memory_runs import BitRun, RegisterRun, Run, replace_all


@dataclass(frozen=True, slots=True)
class _Entry:
    """One change in an open group of changes, not visible to Modbus clients yet."""

    run: Run
    position: int
    count: int
    items: bytes


class _Group:
    """The changes of one open group, and copies of the changed memory that the application reads inside the group."""

    __slots__ = ("copies", "is_open", "journal", "owner")

    def __init__(self, owner: "Groups") -> None:
        self.owner = owner
        self.is_open = True
        self.journal: list[_Entry] = []
        self.copies: dict[RegisterRun | BitRun, bytearray] = {}

    def copy_of(self, run: Run) -> bytearray:
        memory = run.memory
        copy = self.copies.get(memory)
        if copy is None:
            copy = self.copies[memory] = bytearray(memory.data)
        return copy


_open_groups: ContextVar[tuple[_Group, ...]] = ContextVar("busway_open_groups", default=())
"""The groups that this thread or task has open, of any device, the innermost last."""


class Groups:
    """An application's reads and writes of one device's memory, at once or in a group of changes.

    Args:
        lock: the lock of the device.
    """

    __slots__ = ("_lock",)

    def __init__(self, lock: threading.RLock) -> None:
        self._lock = lock

    def get(self, run: Run, position: int, count: int) -> bytes:
        """Return the current items of a range; inside an open group, with the changes of that group."""
        group = self._current()
        if group is None:
            return run.get(position, count)
        return run.fetch(group.copy_of(run), position, count)

    def put(self, run: Run, position: int, count: int, items: bytes) -> None:
        """Replace items of a device's memory: at once, or when the open group of changes ends."""
        # Under the lock, because a thread that was started inside the group may come while the group ends.
        with self._lock:
            group = self._current()
            if group is None:
                run.put(position, count, items)
            else:
                run.patch(group.copy_of(run), position, count, items)
                group.journal.append(_Entry(run, position, count, items))

    @contextmanager
    def update(self) -> Iterator[None]:
        """Context manager that opens a group of changes which become visible together.

        An exception that leaves the group drops its changes. A group inside a group joins it: its changes become
        visible with those of the outer group, even if an exception left the inner one and was caught in the outer.
        """
        if self._current() is not None:
            yield
            return
        group = _Group(self)
        token = _open_groups.set((*_open_groups.get(), group))
        try:
            yield
        except BaseException:
            group.is_open = False
            raise
        finally:
            _open_groups.reset(token)
        self._apply(group)

    def _apply(self, group: _Group) -> None:
        with self._lock:
            group.is_open = False
            fresh: dict[RegisterRun | BitRun, bytearray] = {}
            for entry in group.journal:
                memory = entry.run.memory
                data = fresh.get(memory)
                if data is None:
                    data = fresh[memory] = bytearray(memory.data)
                entry.run.patch(data, entry.position, entry.count, entry.items)
            replace_all(fresh)

    def _current(self) -> _Group | None:
        for group in reversed(_open_groups.get()):
            # A task that was started inside a group still has it in its context after the group ended.
            if group.owner is self and group.is_open:
                return group
        return None
