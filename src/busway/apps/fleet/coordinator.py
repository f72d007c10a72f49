"""The interface of coordinators: each keeps a small table that the collectors of a zone change by compare-and-set.

Knows no engine. The backends in `coordinators` keep these rules, which one set of tests checks for all of them:

1. An entry has a revision, which grows with every change of it. An entry with an empty value counts as deleted; it
   keeps its revision, and a later change starts from that.
2. `Coordinator.create` and `Coordinator.replace` change an entry only if it is as the caller has seen it. A change that
   was confirmed is never lost, and of two that expect the same revision one is refused.
3. If the answer is missing, `OutcomeUnknown` says so: the change was made, or was not, or is made later.
4. A watch gives every entry that exists, then `SNAPSHOT_ENDS`, then changes. It may leave out values that were replaced
   meanwhile, but never goes back in the revisions of a key. After a lost connection, or any other error of the engine,
   it begins again by itself, with `SNAPSHOT_BEGINS`, as often as needed; where what it had shown was wrong, revisions
   may be lower from there on. The log has a line when this begins, and one when all entries were shown again. Missing
   rights end it by an error as long as it has not shown all entries once; later they are an outage like any other,
   because rights that were revoked may be granted again.
5. No entry expires: an engine's wall clock decides nothing about leases.
"""

from collections.abc import AsyncGenerator
from dataclasses import dataclass, field
from typing import Final, Protocol

from ...errors import ModbusError


class CoordinatorDown(ModbusError):
    """Error: the coordinator, with the table that collectors share, cannot be used now. Nothing was changed."""


class OutcomeUnknown(ModbusError):
    """Error: no answer says whether a change of the shared table was made; it may have been, or may be made later."""


class RevisionConflict(ModbusError):
    """Error: the entry of the shared table has another revision than the caller expected. Nothing was changed."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry (key, value, revision) of the table that the collectors of a zone share.

    Attributes:
        key: name of the entry: letters, digits, ``.``, ``-``, ``_``, at most 200.
        value: content of the entry, at most `LONGEST_VALUE` bytes; empty for a deleted entry.
        revision: number that grows with every change of the entry, from 1; 0 only in the two marks of a watch.
        time: when the entry was changed, seconds since 1970 UTC by the server's clock; None if the server does not say.
    """

    key: str
    value: bytes
    revision: int
    time: float | None = field(default=None, compare=False)


LONGEST_VALUE: Final = 512 * 1024
SNAPSHOT_BEGINS: Final = Entry("", b"begins", 0)
"""Mark that a watch yields when it begins again: all entries that exist follow once more."""
SNAPSHOT_ENDS: Final = Entry("", b"ends", 0)
"""Mark that a watch yields after all entries that existed when it began: changes follow."""


class Coordinator(Protocol):
    """Interface of a table of entries that several collectors share and change by compare-and-set."""

    async def create(self, key: str, value: bytes) -> int:
        """Add a new entry to the shared table, and return its revision.

        Args:
            key: name of the entry.
            value: content of the entry, at most `LONGEST_VALUE` bytes.

        Raises:
            RevisionConflict: the entry exists, perhaps as a deleted one; nothing was changed.
            CoordinatorDown: nothing was changed.
            OutcomeUnknown: the entry may have been added.
            ConfigError: the value is too long; nothing was changed.
        """

    async def replace(self, key: str, value: bytes, revision: int) -> int:
        """Change an entry of the shared table if it still has the given revision (compare-and-set); return the new one.

        Args:
            key: name of the entry.
            value: new content, at most `LONGEST_VALUE` bytes; empty to delete the entry.
            revision: the revision that the entry must have.

        Raises:
            RevisionConflict: the entry has another revision, or does not exist; nothing was changed.
            CoordinatorDown: nothing was changed.
            OutcomeUnknown: the entry may have been changed.
            ConfigError: the value is too long; nothing was changed.
        """

    def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
        """Yield all entries of the shared table whose keys begin with a prefix, then their changes, until closed.

        `SNAPSHOT_ENDS` comes after the entries that exist. After a lost connection the watch begins again by itself,
        with `SNAPSHOT_BEGINS` (rule 4).

        Raises:
            ConfigError: the table can never be read, because rights are missing. Only before the first `SNAPSHOT_ENDS`.
        """

    async def close(self) -> None:
        """Close the connection to the shared table. The entries of the table stay as they are."""
