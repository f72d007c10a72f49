"""The audit log: an append-only file with one JSON object per line.

Knows a file and lines; does not know their content (`busway.access.audit_line`).

1. Lines are buffered for at most ``interval`` seconds and then written together. Buffered lines are lost when the
   process is killed; ``interval=0`` writes each line before the request is answered.
2. Writing to a file that cannot be written (disk full) is retried. Meanwhile lines are buffered up to a bound; lines
   beyond it are lost and counted, and a line with their number is written when the file can be written again.
   ``on_failure="refuse"`` refuses write requests instead of losing their lines.
3. No line stays incomplete: a line of which only the beginning was written is completed before the next one.
4. Denials that a client repeats are counted, and get one line every ``repeat_interval`` (`RepeatedDenials`).
5. Writes take precedence over denials: if the file system has less than `RESERVED` left, or a quarter of the buffer
   for a failing file is used, denials are only counted. Writes are still recorded.
"""

import asyncio
import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Final, Protocol, Self

from ..errors import ConfigError
from ..options.declaration import declared
from ..options.service import AuditParameters, OnFailure
from ..options.text import build_parameters
from ..safe_files import open_to_append
from .repeated_denials import About, DenialLine, RepeatedDenials

_log = logging.getLogger("busway.audit")

_USUAL: Final = declared(AuditParameters)
_CHUNK: Final = 64 * 1024
"""Characters of lines that are written without waiting for the interval: one write of this size takes 50 µs."""
_KEPT: Final = 4 * 1024 * 1024
"""Most bytes of lines that are buffered for a file that cannot be written: some 15 000 lines."""
_KEPT_OF_DENIALS: Final = 0.25
"""Part of the buffer (`_KEPT`): while more than that is used, denials get no lines and are only counted."""
RESERVED: Final = 0.05
"""Part of a file system that is kept free for lines of writes, but at most `MOST_RESERVED` bytes."""
MOST_RESERVED: Final = 256 * 1024 * 1024
"""Most bytes of a file system that are kept free for lines of writes: some 900 000 lines."""
_RETRY: Final = 1.0
"""Seconds between two attempts to write to a file that cannot be written."""
_LOOK_PAUSE: Final = 1.0
"""Seconds between two checks of the free space of the file system."""
_LATE: Final = 1.0
"""Most seconds that a timer may be late; after that, its event loop is taken to have ended."""


class FlushSchedule(Protocol):
    """Interface of the function that schedules a later call of a method of the audit log.

    The audit log uses it to write buffered lines, and to append lines about repeated denials.
    """

    def __call__(self, seconds: float, function: Callable[[], None], /) -> bool:
        """Let ``function`` be called after ``seconds``. Return True if it will be, False if no event loop can do it."""


def by_event_loop(seconds: float, function: Callable[[], None]) -> bool:
    """Let the running event loop call ``function`` after ``seconds``. Return True; False if no loop is running."""
    try:
        asyncio.get_running_loop().call_later(seconds, function)
    except RuntimeError:
        return False
    return True


class WallClock:
    """A clock: calling it returns the current UTC time as text, ``2026-03-01T12:00:00.250Z``.

    The text is formatted at most once a millisecond. It can be called from any thread.

    Args:
        now: function that returns the current time in seconds since 1970.
    """

    __slots__ = ("_now", "_second", "_text")

    def __init__(self, now: Callable[[], float] = time.time) -> None:
        self._now = now
        # Each replaced as a whole: a second and its text; from when until when a text is right for certain, and it.
        self._second = (-1, "")
        self._text = (0.0, 0.0, "")

    def __call__(self) -> str:
        now = self._now()
        since, until, text = self._text
        if since <= now < until:
            return text
        whole = int(now)
        second, prefix = self._second
        if second != whole:
            prefix = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(whole))
            self._second = whole, prefix
        milliseconds = int((now - whole) * 1000)
        text = f"{prefix}.{milliseconds:03d}Z"
        # Numbers of this size are exact to 0.2 µs: the last microsecond of each millisecond is looked at anew.
        self._text = now, whole + (milliseconds + 1) / 1000 - 1e-6, text
        return text


Room = Callable[[int], tuple[int, int]]
"""Function that takes an open file's descriptor, and returns the free and the total bytes of its file system."""


def room_of_file(file: int) -> tuple[int, int]:
    """Return free and total bytes of the file system of an open file, given by its descriptor. Raises `OSError`.

    The free bytes are those that this user may write. On systems that do not tell (Windows), both are `MOST_RESERVED`,
    so that the space always suffices.
    """
    if not hasattr(os, "fstatvfs"):
        return MOST_RESERVED, MOST_RESERVED
    facts = os.fstatvfs(file)
    return facts.f_bavail * facts.f_frsize, facts.f_blocks * facts.f_frsize


class AuditLog:
    """An append-only file of JSON lines about writes and denied requests.

    Any number of threads and servers can share it. As a context manager it is closed at the end.

    Args:
        path: the file; created with rights for its owner alone (0600) if it does not exist, never truncated.
        interval: most seconds, 0…10, until a line is in the file; 0, or without an event loop: at once.
        on_failure: what happens to write requests while the file cannot be written. ``serve``: they are executed, and
            lost lines are counted and logged. ``refuse``: they are answered with exception 04.
        repeat_interval: seconds, 0…3600, after which repeated denials get a line with their number; 0: each denial gets
            a line of its own.
        schedule: calls a function later; the running event loop by default.
        clock: returns monotonic seconds.
        now: returns seconds since 1970, for the time in the lines.
        room: takes the file's descriptor, and returns free and total bytes of its file system.

    Raises:
        ConfigError: the file cannot be opened or is no regular file, or an argument is not valid.

    Attributes:
        path: the file.
        timestamp: called without arguments, returns the current time as the text for a line.
        written: number of lines written to the file, those about lost lines and left-out denials included.
        lost: number of lines that could be neither written nor buffered.
        failures: number of attempts to write that failed.
        is_failing: whether the last attempt to write failed.
        denials_left_out: number of denials without a line, because the space is kept for writes.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        interval: float = _USUAL["interval"].default,
        on_failure: str = _USUAL["on_failure"].default.value,
        repeat_interval: float = _USUAL["repeat_interval"].default,
        schedule: FlushSchedule = by_event_loop,
        clock: Callable[[], float] = time.monotonic,
        now: Callable[[], float] = time.time,
        room: Room = room_of_file,
    ) -> None:
        given = {"interval": interval, "on_failure": on_failure, "repeat_interval": repeat_interval}
        parameters = build_parameters(AuditParameters, {"path": path, **given})
        self.path: Path = Path(path)
        self.timestamp: WallClock = WallClock(now)
        self.written: int = 0
        self.lost: int = 0
        self.failures: int = 0
        self.is_failing: bool = False
        self.denials_left_out: int = 0
        self._interval = parameters.interval
        self._repeat_interval = parameters.repeat_interval
        self._repeated = RepeatedDenials()
        self._repeated_due: float | None = None
        self._room = room
        self._has_room = True
        self._looked = -_LOOK_PAUSE
        self._left_out = 0  # of them, those that no line has told yet
        self._refuses = parameters.on_failure is OnFailure.REFUSE
        self._schedule = schedule
        self._clock = clock
        self._lock = threading.RLock()
        self._lines: list[str] = []
        self._size = 0
        self._begun = b""  # the end of a line whose beginning is in the file
        self._untold = 0
        self._due: float | None = None
        self._file: int | None = self._open()

    @property
    def takes_writes(self) -> bool:
        """Whether write requests may be executed now.

        False if ``on_failure`` is ``refuse``, and the last attempt to write failed or the log is closed.
        """
        return not (self._refuses and (self.is_failing or self._file is None))

    def append(self, line: str) -> None:
        """Append one audit line: ASCII text that ends with a line feed.

        It is in the file after at most ``interval`` seconds, or as soon as the file can be written again. Raises
        nothing: a line that can be neither written nor buffered is dropped, and counted in ``lost``.
        """
        with self._lock:
            if self._file is None or self._size >= _KEPT:
                self._lose(1)
                return
            self._lines.append(line)
            self._size += len(line)
            if self._due is None:
                waits = _RETRY if self.is_failing else self._interval
                if not waits or not self._schedule(waits, self.flush):
                    self.flush()
                else:
                    self._due = self._clock() + waits
            elif self._size >= _CHUNK and not self.is_failing:
                self._write_kept()  # the timer stays, for what comes after
            elif self._clock() > self._due + _LATE:
                self.flush()

    def append_denied(self, about: About, line: DenialLine) -> None:
        """Append the audit line of a denied request, or only count the request if it repeats an earlier one.

        If the remaining space is kept for writes, the line is left out, and counted in ``denials_left_out``.

        Args:
            about: host, role and rule; denials that agree in all three are repetitions of each other.
            line: function that creates the line; called with 0 for the line about this denial alone, or later with the
                number of repetitions that the line stands for.
        """
        with self._lock:
            if self._repeated_due is not None and self._clock() > self._repeated_due + _LATE:
                self._append_repeated()  # whose event loop has gone
            if not self._repeat_interval:
                self._append_denied(line, 0)
                return
            if self._repeated.is_first(about, line):
                self._append_denied(line, 0)
            if self._repeated_due is None:
                self._repeated_due = self._clock() + self._repeat_interval
                self._schedule(self._repeat_interval, self._append_repeated)

    def flush(self) -> None:
        """Write the buffered audit lines to the file now. Raises nothing: a failure is counted, logged and retried.

        The retry is made a second later; without an event loop, when the next line is appended.
        """
        with self._lock:
            self._due = None
            self._write_kept()

    def reopen(self) -> None:
        """Close the audit file and open the same path again, after log rotation has renamed the file.

        Buffered lines are written to the old file first; those that it does not take are written to the new one. A line
        of which the old file has only the beginning is lost. A log that was closed stays closed.

        Raises:
            ConfigError: the file cannot be opened; then the old file stays in use.
        """
        with self._lock:
            if self._file is None:
                return
            self._append_left_out()
            self.flush()
            fresh = self._open()
            os.close(self._file)
            self._file = fresh
            if self._begun:  # half a line is none
                self._begun = b""
                self._lose(1)
            self.flush()

    def close(self) -> None:
        """Write the buffered audit lines and close the file.

        Lines that cannot be written now, and lines appended later, are lost, and counted in ``lost``.
        """
        with self._lock:
            self._append_repeated()
            self._append_left_out()
            self.flush()
            file, self._file = self._file, None
            if file is not None:
                os.close(file)
            self._lose(len(self._lines) + bool(self._begun))
            self._lines, self._size, self._begun = [], 0, b""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open(self) -> int:
        try:
            return open_to_append(self.path)
        except ConfigError as error:
            raise ConfigError(f"the audit log {error.message}", file=str(self.path)) from error

    # ---- denials

    def _append_denied(self, line: DenialLine, repeated: int) -> None:
        """Append an audit line about denied requests if there is space for it, else count those requests as left out.

        ``line`` creates the line. ``repeated``: how many denials the line stands for; 0 for a single one.
        """
        if self._has_room_for_denials():
            self._append_left_out()
            self.append(line(repeated))
        else:
            self.denials_left_out += repeated or 1
            self._left_out += repeated or 1

    def _append_repeated(self) -> None:
        """Append an audit line for each client and rule whose denials were only counted since the last call.

        One more line is for all denials that were not counted by client and rule. The next call is scheduled if a
        client repeated a denial.
        """
        with self._lock:
            self._repeated_due = None
            for line, count in self._repeated.take():
                self._append_denied(line, count)
            others = self._repeated.take_others()
            if others:
                self._append_denied(lambda repeated: _others_line(self.timestamp(), repeated), others)
            if self._repeated and self._file is not None:
                self._repeated_due = self._clock() + self._repeat_interval
                self._schedule(self._repeat_interval, self._append_repeated)

    def _append_left_out(self) -> None:
        """If denials were left out since the last such line, append an audit line with their number."""
        if self._left_out:
            left_out, self._left_out = self._left_out, 0
            self.append(f'{{"time":"{self.timestamp()}","outcome":"denials left out","lines":{left_out}}}\n')

    def _has_room_for_denials(self) -> bool:
        if self._size >= _KEPT * _KEPT_OF_DENIALS:
            return False
        now = self._clock()
        if now - self._looked >= _LOOK_PAUSE and self._file is not None:
            self._looked = now
            try:
                free, whole = self._room(self._file)
            except OSError:  # a write will say what is wrong
                return self._has_room
            self._now_has_room(free >= min(RESERVED * whole, MOST_RESERVED), free)
        return self._has_room

    def _now_has_room(self, has_room: bool, free: int) -> None:
        if has_room is not self._has_room:
            self._has_room = has_room
            if has_room:
                _log.warning("%s: denials are logged again; %d were not logged", self.path, self._left_out)
            else:
                _log.error("%s: denials are not logged: the %d bytes left are kept for writes", self.path, free)

    # ---- the file

    def _write_kept(self) -> None:
        data = self._begun + "".join(self._lines).encode("ascii", "backslashreplace")
        if self._file is None or not data:
            return
        at = 0
        try:
            while at < len(data):
                at += os.write(self._file, data[at:] if at else data)
        except OSError as error:
            self._keep(data, at)
            self._failed(error)
        else:
            self._keep(data, at)
            self._recovered()

    def _keep(self, data: bytes, at: int) -> None:
        """Remove written audit lines from the buffer and count them; lines that a write has not written stay.

        ``data`` is the text of all buffered lines, of which the file has taken the first ``at`` bytes.
        """
        if at == len(data):
            self.written += len(self._lines) + bool(self._begun)
            self._lines, self._size, self._begun = [], 0, b""
            return
        self.written += data.count(b"\n", 0, at)
        left = data[at:]
        is_inside = data[at - 1] != ord("\n") if at else bool(self._begun)
        end = left.index(b"\n") + 1 if is_inside and left else 0
        self._begun = left[:end]
        self._lines = left[end:].decode("ascii").splitlines(keepends=True)
        self._size = len(left)

    def _failed(self, error: OSError) -> None:
        self.failures += 1
        if not self.is_failing:
            self.is_failing = True
            reason = error.strerror or str(error)
            _log.error("%s: the audit log cannot be written: %s", self.path, reason[:1].lower() + reason[1:])
        if self._schedule(_RETRY, self.flush):
            self._due = self._clock() + _RETRY

    def _recovered(self) -> None:
        if self.is_failing:
            self.is_failing = False
            _log.warning("%s: the audit log is written again; %d lines were lost", self.path, self._untold)
        if self._untold:
            lost, self._untold = self._untold, 0
            self.append(f'{{"time":"{self.timestamp()}","outcome":"lost","lines":{lost}}}\n')

    def _lose(self, lines: int) -> None:
        self.lost += lines
        self._untold += lines


def _others_line(time: str, repeated: int) -> str:
    """Return the audit line for denials that were not counted by client and rule, because there were too many of those.

    ``time`` is the time as text; ``repeated`` is the number of denials.
    """
    return f'{{"time":"{time}","outcome":"denied","repeated":{repeated}}}\n'
