"""The keys of commands that one entry of a zone's table remembers, and the results of the newest, as data and as bytes.

Each command that writes a point has a key, and is sent at most once. Pure: knows no coordinator and no clock.

1. A key is remembered as 16 bytes and the time of its use. `MOST_KEYS` are kept; then the oldest are forgotten, but
   none that is younger than `REMEMBERED` seconds: as long as all are younger, new keys are refused.
2. `REMEMBERED` is longer than a command may wait (`LONGEST_SECONDS`): a command that has an expiry time has expired
   before its key is forgotten.
3. Only the newest results are kept, up to `MOST_BYTES`. A second command with a key whose result is no longer kept is
   refused.
4. Of a key that a collector made itself only the result is kept: no caller can give such a key again.
5. An entry that cannot be read is an error, never an empty memory.
"""

import base64
import hashlib
import json
import struct
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Final

from ...errors import InvalidRequest, Overloaded
from ..collector.commands.claims import KeysUnavailable
from ..collector.commands.command import MADE, CommandResult, CommandState, OldValue, PointCommand

MOST_KEYS: Final = 4096
REMEMBERED: Final = 90 * 86_400.0
MOST_BYTES: Final = 64 * 1024
_KEY: Final = struct.Struct(">16sI")


@dataclass(slots=True)
class KeyMemory:
    """The keys of commands that were used, when each was used, and the results of the newest commands.

    Attributes:
        used: when each key given by a caller was used, in seconds since 1970 UTC, by digest of the key; in the order of
            use.
        results: for the newest keys, by key, the owner that took the key and the result of its command so far. An owner
            is ``collector/run``: the name of a collector and a random word for this start of the collector.
    """

    used: dict[bytes, int] = field(default_factory=dict)
    results: dict[str, tuple[str, CommandResult]] = field(default_factory=dict)

    def found(self, result: CommandResult) -> CommandResult | None:
        """Return the result of the first command with the key of this command; None if the key is new.

        Args:
            result: the command whose key is looked up, with its result so far.

        Returns:
            The first command's final result. If the first command is not finished, its result with the state
            ``UNKNOWN``; if its result is no longer kept, a copy of ``result`` with the state ``REFUSED``.
        """
        key = result.command.key
        if key in self.results:
            owner, first = self.results[key]
            if first.state is not CommandState.OPEN:
                return first
            reason = f"{owner.partition('/')[0]} has begun it, and nothing says what became of it; it is not sent again"
            return first.finished(CommandState.UNKNOWN, reason)
        if _digest(key) in self.used:
            return result.finished(CommandState.REFUSED, "this key was used before, long ago; nothing was sent now")
        return None

    def add(self, result: CommandResult, owner: str, now: float) -> None:
        """Remember a new key with the result of its command so far.

        Args:
            result: the command with the key.
            owner: ``collector/run`` of the collector that takes the key.
            now: seconds since 1970 UTC.

        Raises:
            Overloaded: the memory is full, and all keys are too young to be forgotten (rule 1).
        """
        key = result.command.key
        if not key.startswith(MADE):
            if len(self.used) >= MOST_KEYS:
                self._forget(now)
            self.used[_digest(key)] = int(now)
        self.results[key] = owner, result

    def include(self, other: "KeyMemory") -> None:
        """Also remember what another, older memory of the same entry has; of one command, the result that is final."""
        self.used = {**other.used, **self.used}
        both = {**other.results, **self.results}
        for key, (_, result) in other.results.items():
            if both[key][1].state is CommandState.OPEN and result.state is not CommandState.OPEN:
                both[key] = other.results[key]
        self.results = both

    def is_open(self, key: str, owner: str) -> bool:
        """Whether this owner (``collector/run``) took the key for a command that is not finished."""
        found = self.results.get(key)
        return found is not None and found[0] == owner and found[1].state is CommandState.OPEN

    def end(self, result: CommandResult) -> bool:
        """Record the final result of a command, and return True.

        Returns False and changes nothing if no result is kept for its key any more. The key stays used either way.
        """
        key = result.command.key
        if key not in self.results:
            return False
        self.results[key] = self.results[key][0], result
        return True

    def _forget(self, now: float) -> None:
        old = [digest for digest, at in self.used.items() if at < now - REMEMBERED]
        if not old:
            days = f"{REMEMBERED / 86_400:g} days"
            raise Overloaded(f"the fleet remembers keys for {days}, and more were used than it can remember")
        for digest in islice(old, MOST_KEYS // 10):
            del self.used[digest]

    def encode(self) -> bytes:
        """Return the memory as bytes for the shared table: all keys, and the newest results up to `MOST_BYTES` in all.

        The newest result is always there, even if it alone is longer.
        """
        newest: list[str] = []
        left = MOST_BYTES
        for owner, result in reversed(self.results.values()):
            text = json.dumps([owner, *_record(result)], separators=(",", ":"))
            left -= len(text)
            if left < 0 and newest:
                break
            newest.append(text)
        used = b"".join(_KEY.pack(digest, at) for digest, at in self.used.items())
        return f'{{"keys":"{base64.b64encode(used).decode()}","results":[{",".join(reversed(newest))}]}}'.encode()


def decode_memory(value: bytes) -> KeyMemory:
    """Return the keys of commands in the bytes of a table entry. Raises `KeysUnavailable` if they cannot be read."""
    try:
        found = json.loads(value)
        used = dict(_KEY.iter_unpack(base64.b64decode(found["keys"], validate=True)))
        results = {each[1]: (str(each[0]), _result(*each[1:])) for each in found["results"]}
    except (ValueError, TypeError, LookupError, RecursionError, struct.error, InvalidRequest) as error:
        raise KeysUnavailable(f"the keys of the fleet cannot be read by this program: {error}") from error
    return KeyMemory(used, results)


def _digest(key: str) -> bytes:
    return hashlib.sha256(key.encode()).digest()[:16]


def _record(result: CommandResult) -> list[Any]:  # JSON
    command, old = result.command, result.old
    return [
        command.key,
        command.device,
        command.point,
        command.value,
        command.by,
        command.origin,
        command.expires,
        result.state.value,
        result.at,
        None if old is None else [old.value, old.quality, old.time],
        result.read_back,
        result.reason,
    ]


def _result(
    key: str,
    device: str,
    point: str,
    value: Any,  # of JSON, checked by `PointCommand`
    by: str,
    origin: str,
    expires: float,
    state: str,
    at: float,
    old: list[Any] | None,
    read_back: Any,
    reason: str,
) -> CommandResult:
    command = PointCommand(key, device, point, value, by, origin, expires)
    return CommandResult(
        command, CommandState(state), at, None if old is None else OldValue(*old), read_back, str(reason)
    )
