"""Folders as a power failure could have left them: recorded writes, cut at some point.

What is durable at a point: of each file the content at its last fsync, under the name that it had at the last fsync of
its folder. Writes after that may be there or not, each for itself (`PowerFailure.left`).

`recorded_writes.c` makes the record.
"""

import os
import random
from dataclasses import dataclass, field
from pathlib import Path

SOURCE = Path(__file__).with_name("recorded_writes.c")


@dataclass(frozen=True, slots=True)
class Record:
    """One operation: its letter (see `recorded_writes.c`), path, offset and data."""

    operation: str
    path: str
    offset: int
    data: bytes


@dataclass(slots=True)
class Content:
    """What is in one file: durable bytes, and operations since its last fsync."""

    durable: bytearray = field(default_factory=bytearray)
    pending: list[Record] = field(default_factory=list)


def environment(library: Path, store: Path, log: Path) -> dict[str, str]:
    """The environment in which a program is recorded."""
    wanted = {"LD_PRELOAD": str(library), "RECORD_FOLDER": str(store), "RECORD_LOG": str(log)}
    return {**os.environ, **wanted}


def records_of(log: Path) -> list[Record]:
    """What was recorded."""
    data, at, found = log.read_bytes(), 0, []
    while at < len(data):
        end = data.index(b"\n", at)
        operation, offset, length, path = data[at:end].decode().split(" ", 3)
        at = end + 1 + int(length)
        found.append(Record(operation, path, int(offset), data[end + 1 : at]))
    return found


class PowerFailure:
    """The state of a folder after a number of records."""

    def __init__(self) -> None:
        self.names: dict[str, Content] = {}
        self.durable_names: dict[str, Content] = {}

    def apply(self, record: Record) -> None:
        """One more operation has happened."""
        path = record.path
        if record.operation == "c":
            if path in self.names:
                self.names[path].pending.append(Record("t", path, 0, b""))
            else:
                self.names[path] = Content()
        elif record.operation in "wt":
            self.names.setdefault(path, Content()).pending.append(record)
        elif record.operation == "s":
            content = self.names.setdefault(path, Content())
            for each in content.pending:
                _change(content.durable, each)
            content.pending.clear()
        elif record.operation == "d":
            for name in {*self.names, *self.durable_names}:
                if os.path.dirname(name) != path:
                    continue
                if name in self.names:
                    self.durable_names[name] = self.names[name]
                else:
                    self.durable_names.pop(name, None)
        elif record.operation == "r":
            self.names[record.data.decode()] = self.names.pop(path)
        elif record.operation == "u":
            self.names.pop(path, None)

    def left(self, kept: random.Random | None) -> dict[str, bytes]:
        """What a power failure leaves now: what is durable, and with ``kept`` also some writes that are not yet."""
        names = dict(self.durable_names)
        if kept is not None:
            for name in sorted({*self.names, *self.durable_names}):
                if kept.random() < 0.5:
                    continue
                if name in self.names:
                    names[name] = self.names[name]
                elif self._is_old_database(name):
                    names.pop(name, None)
        left = {}
        for name, content in names.items():
            data = bytearray(content.durable)
            for each in content.pending:
                if kept is not None and kept.random() < 0.5:
                    _change(data, each)
            left[name] = bytes(data)
        return left

    def _is_old_database(self, name: str) -> bool:
        return not name.endswith("-wal")


def _change(data: bytearray, record: Record) -> None:
    if record.operation == "t":
        del data[record.offset :]
        data.extend(bytes(record.offset - len(data)))
        return
    end = record.offset + len(record.data)
    data.extend(bytes(max(0, end - len(data))))
    data[record.offset : end] = record.data


def lay_out(left: dict[str, bytes], store: Path, target: Path) -> None:
    """Write the files that were left into another folder."""
    for name, data in left.items():
        path = target / Path(name).relative_to(store)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
