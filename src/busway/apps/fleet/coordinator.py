"""The interface of coordinators: each keeps a small table that the collectors of a zone change by compare-and-set.

Knows no engine. The backends in `coordinators` keep these rules, which one set of tests checks for all of them:

1. An entry has a revision, which grows with every change of it. An empty value says that it was deleted; it keeps its
   revision, and is changed from there.
2. `Coordinator.create` and `Coordinator.replace` change an entry only if it is as the caller has seen it. A change that
   was confirmed is never lost, and of two that expect the same revision one is refused.
3. Where the answer is missing, `OutcomeUnknown` says so: the change was made, or was not, or is made later.
4. A watch gives every entry that exists, then `SNAPSHOT_ENDS`, then changes. It may leave out values that were replaced
   meanwhile, but never goes back in the revisions of a key. After a lost connection it begins again by itself, with
   `SNAPSHOT_BEGINS`; where what it had shown was wrong, revisions may be lower from there on.
5. No entry expires: an engine's wall clock decides nothing about leases.
"""

from collections.abc import AsyncGenerator
from dataclasses import dataclass, field
from typing import Final, Protocol

from ...errors import ModbusError


class CoordinatorDown(ModbusError):
    """Error: the coordinator, which keeps the table that collectors share, cannot be reached. Nothing was changed."""


class OutcomeUnknown(ModbusError):
    """Error: it is not known whether the coordinator (the shared table) has made a change."""


class RevisionConflict(ModbusError):
    """Error: the entry of the shared table has another revision than expected. Nothing was changed."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry (key, value, revision) of the table that the collectors of a zone share.

    Attributes:
        key: letters, digits, ``.``, ``-``, ``_``, at most 200.
        value: its content, at most `LONGEST_VALUE` bytes; empty for a deleted entry.
        revision: from 1; 0 only in the two marks of a watch.
        time: when it was changed, seconds since 1970 UTC by the server's clock; None where the server does not say.
    """

    key: str
    value: bytes
    revision: int
    time: float | None = field(default=None, compare=False)


LONGEST_VALUE: Final = 512 * 1024
SNAPSHOT_BEGINS: Final = Entry("", b"begins", 0)
"""Given by a watch that begins again: the entries that exist follow once more."""
SNAPSHOT_ENDS: Final = Entry("", b"ends", 0)
"""Given by a watch after the entries that existed when it began."""


class Coordinator(Protocol):
    """Interface of a table of entries that several collectors share and change by compare-and-set."""

    async def create(self, key: str, value: bytes) -> int:
        """Add a new entry to the shared table; returns its revision.

        Raises:
            RevisionConflict: it exists.
            CoordinatorDown: nothing was changed.
            OutcomeUnknown: it may have been added.
        """

    async def replace(self, key: str, value: bytes, revision: int) -> int:
        """Change an entry of the shared table if it still has this revision; returns the new one.

        Raises:
            RevisionConflict: it has another one, or does not exist.
            CoordinatorDown: nothing was changed.
            OutcomeUnknown: it may have been changed.
        """

    def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
        """Yield the entries of the shared table whose keys begin with a prefix, then their changes, until closed (rule
        4).

        Raises nothing for a lost connection; `ConfigError` where it can never work (rights, a wrong bucket).
        """

    async def close(self) -> None:
        """End the connection to the shared table. Its entries stay as they are."""
