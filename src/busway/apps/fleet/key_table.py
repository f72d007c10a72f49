"""The keys of all commands of a zone, in a table that its collectors share: each key is sent at most once.

Knows the coordinator; what an entry remembers is decided by `key_memory`. Works on every backend.

1. A key belongs to one of `SLOTS` entries by its hash. It is taken by compare-and-set of the whole entry: of two
   collectors that take one key, one changes the entry and the other finds the key there. The table never has more
   entries than that.
2. Entries are not read: a watch shows them. If the watch lags, an entry known here is out of date; then the change is
   refused as a conflict, and made again once the watch shows the newer entry.
3. If the outcome of taking a key is not known, the command is refused and nothing is sent. The entry may still name
   this collector as the one that took the key. If a command with that key comes to this collector again, it takes the
   key again; for other collectors the result of the command is unknown.
4. The end of a command is written in up to three tries. If all fail, the key stays taken, and for other collectors the
   result of the command is unknown.
5. If the table has lost an entry, or shows an older one (it was replaced, or put back from a backup), a collector goes
   on with all that it has seen of that entry, and writes it with its next key. Keys that no running collector has seen
   are lost with the table.
"""

import asyncio
import hashlib
import logging
import secrets
import time
from collections.abc import Callable
from contextlib import aclosing
from types import TracebackType
from typing import Final, Self

from ...errors import ConfigError
from ..collector.cancellation import end_tasks
from ..collector.commands.claims import KeysUnavailable
from ..collector.commands.command import CommandResult
from .coordinator import SNAPSHOT_BEGINS, SNAPSHOT_ENDS, Coordinator, CoordinatorDown, OutcomeUnknown, RevisionConflict
from .key_memory import KeyMemory, decode_memory
from .lease_driver import keep_following

KEYS: Final = "keys."
SLOTS: Final = 256
"""Number of entries for keys in the table. It must never change: all collectors of a zone need the same."""
MOST_DOUBTFUL: Final = 1000
"""Most keys that are remembered as perhaps taken by this collector, by a change without an answer (rule 3)."""
CLAIM_SECONDS: Final = 8.0
"""Longest wait in seconds for a key to be taken; after it the command is refused."""
RECORD_AGAIN: Final = (0.0, 0.5, 2.0)
"""Pause in seconds before each of the three tries to write the end of a command."""
_log = logging.getLogger("busway.fleet")


def slot_of(key: str) -> str:
    """Return the name of the entry of the shared table that remembers a command's key: ``keys.000`` … ``keys.255``."""
    return f"{KEYS}{int.from_bytes(hashlib.sha256(key.encode()).digest()[-2:], 'big') % SLOTS:03d}"


class KeyTable:
    """Reserves the key of each command in a table of the zone, so that no two collectors send it.

    Works while the ``async with`` block lasts. It is the `KeyClaims` of a collector of a fleet.

    Args:
        table: the table of keys, which all collectors of the zone share; not closed here.
        collector: name of the collector.
        now: returns the time in seconds since 1970 UTC.
    """

    def __init__(self, table: Coordinator, collector: str, *, now: Callable[[], float] = time.time) -> None:
        self._table, self._now = table, now
        self._owner = f"{collector}/{secrets.token_hex(6)}"
        self._seen: dict[str, tuple[bytes, int]] = {}
        self._shown_again: set[str] = set()
        self._lost: dict[str, list[bytes]] = {}
        """Values of entries that the table has no longer, until they are part of its entries again (rule 5)."""
        self._readings = 0  # how often a reading of the whole table has begun or ended
        self._told = asyncio.Event()
        self._locks: dict[str, asyncio.Lock] = {}
        self._doubtful: dict[str, None] = {}
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Begin to follow the shared table of keys in a task."""
        self._task = asyncio.create_task(self._follow(), name="busway fleet keys")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop following the shared table of keys. All commands must have ended before."""
        assert self._task is not None
        await end_tasks([self._task])

    async def claim(self, result: CommandResult) -> CommandResult | None:
        """Take the key of a command for all collectors of the zone, in at most `CLAIM_SECONDS`.

        Args:
            result: the command with its result so far: open if it will be sent, final if it will not be sent.

        Returns:
            None if the key was new and is taken now; otherwise the result of the first command with this key, as
            `KeyMemory.found` describes it.

        Raises:
            KeysUnavailable: it is not known whether the key is new. The command must not be sent.
            Overloaded: no further key can be remembered. The command must not be sent.
        """
        key = result.command.key
        try:
            async with asyncio.timeout(CLAIM_SECONDS):
                found = await self._change(key, lambda memory: self._taken(memory, result))
        except CoordinatorDown as error:
            raise KeysUnavailable(f"the fleet's table of keys does not answer: {error}") from error
        except (OutcomeUnknown, TimeoutError) as error:
            self._doubt(key)
            raise KeysUnavailable(f"the fleet's table of keys does not confirm: {str(error) or 'no answer'}") from error
        self._doubtful.pop(key, None)
        return found

    def known(self, result: CommandResult) -> CommandResult | None:
        """Return the result of the first command with this command's key, without waiting; None if none is known.

        Takes no key. Only entries that the watch has shown so far are known here, so only `claim` tells that a key is
        new.
        """
        try:
            return self._memory(slot_of(result.command.key)).found(result)
        except KeysUnavailable:
            return None  # nothing is sent on this: `claim` decides

    async def finish(self, result: CommandResult) -> None:
        """Record the final result of a command for all collectors of the zone, in up to three tries.

        Raises nothing. If all tries fail, the result of the command is unknown to other collectors (rule 4).
        """
        for pause in RECORD_AGAIN:
            await asyncio.sleep(pause)
            try:
                async with asyncio.timeout(CLAIM_SECONDS):
                    await self._change(result.command.key, lambda memory: (None, memory.end(result)))
            except (KeysUnavailable, CoordinatorDown, OutcomeUnknown, TimeoutError) as error:
                _log.warning("the end of command %s is not recorded in the zone yet: %s", result.command.key, error)
            else:
                return

    def _taken(self, memory: KeyMemory, result: CommandResult) -> tuple[CommandResult | None, bool]:
        if result.command.key in self._doubtful and memory.is_open(result.command.key, self._owner):
            return None, memory.end(result)
        found = memory.found(result)
        if found is None:
            memory.add(result, self._owner, self._now())
        return found, found is None

    def _doubt(self, key: str) -> None:
        """Remember that a key may be taken for this collector, though its command was refused and not sent (rule 3)."""
        self._doubtful[key] = None
        if len(self._doubtful) > MOST_DOUBTFUL:
            del self._doubtful[next(iter(self._doubtful))]

    async def _change(
        self, key: str, change: Callable[[KeyMemory], tuple[CommandResult | None, bool]]
    ) -> CommandResult | None:
        """Change the table entry that remembers a key by compare-and-set; tried again after each conflict.

        Args:
            key: the key of a command.
            change: changes the `KeyMemory` of the entry in place. It returns the result for the caller of this method,
                and whether the entry has to be written.

        Returns:
            The first thing that ``change`` returned.

        Raises:
            KeysUnavailable: the entry cannot be read.
            Overloaded: raised by ``change``; nothing was changed.
            CoordinatorDown: nothing was changed.
            OutcomeUnknown: the entry may have been changed.
        """
        slot = slot_of(key)
        async with self._locks.setdefault(slot, asyncio.Lock()):
            while True:
                revision = self._revision(slot)
                lost, readings = self._lost.get(slot), self._readings
                memory = self._memory(slot)
                found, is_changed = change(memory)
                if not is_changed:
                    return found
                try:
                    encoded = memory.encode()
                    if revision:
                        made = await self._table.replace(slot, encoded, revision)
                    else:
                        made = await self._table.create(slot, encoded)
                except RevisionConflict:
                    await self._shown_after(slot, revision)
                else:
                    if readings != self._readings:  # the table may have lost this meanwhile
                        self._lost[slot] = [*self._lost.get(slot, ()), encoded]
                        return found
                    if lost is not None:
                        self._lost.pop(slot, None)
                    self._show(slot, encoded, made)
                    return found

    async def _shown_after(self, slot: str, revision: int) -> None:
        while self._revision(slot) == revision:
            self._told.clear()
            await self._told.wait()

    def _revision(self, slot: str) -> int:
        return self._seen.get(slot, (b"", 0))[1]

    def _memory(self, slot: str) -> KeyMemory:
        """Return what is known of an entry, with what the table has lost of it. `KeysUnavailable`: it is unreadable."""
        value = self._seen.get(slot, (b"", 0))[0]
        memory = decode_memory(value) if value else KeyMemory()
        for each in reversed(self._lost.get(slot, ())):
            memory.include(decode_memory(each))
        return memory

    def _show(self, slot: str, value: bytes, revision: int) -> None:
        known = self._revision(slot)
        if slot in self._shown_again or revision > known:
            if revision < known or not value:
                self._lose(slot)
            self._shown_again.discard(slot)
            self._seen[slot] = value, revision
            self._told.set()

    def _lose(self, slot: str) -> None:
        """Keep what is known of an entry that the table has no longer, or in an older state (rule 5)."""
        value, _ = self._seen.pop(slot, (b"", 0))
        if value:
            self._lost[slot] = [*self._lost.get(slot, ()), value]

    def _begin_anew(self) -> None:
        self._readings += 1
        self._shown_again = set(self._seen)

    def _end_snapshot(self) -> None:
        for slot in self._shown_again:
            self._lose(slot)
        self._readings += 1
        self._shown_again = set()
        self._told.set()

    async def _follow(self) -> None:
        try:
            await keep_following(self._follow_table, "the table of keys", self._begin_anew)
        except ConfigError as error:
            _log.error("no command is taken: the fleet's table of keys cannot be followed: %s", error)

    async def _follow_table(self) -> None:
        async with aclosing(self._table.watch(KEYS)) as entries:
            async for entry in entries:
                if entry is SNAPSHOT_BEGINS:
                    self._begin_anew()
                elif entry is SNAPSHOT_ENDS:
                    self._end_snapshot()
                elif entry.revision:
                    self._show(entry.key, entry.value, entry.revision)
