"""The latest log messages of a collector, for its page: records of all loggers of busway, in a bounded buffer.

Knows `logging`; knows no request. Records come from any thread.

1. The last `MOST_LINES` messages of level INFO and above are kept, each cut at `LONGEST_LINE` characters.
2. Invisible characters in texts from devices and certificates are escaped, so that no name can forge a line.
3. The handler is installed only while the page is served. Meanwhile the logger ``busway`` lets INFO through, also if
   its level was higher; its level is restored afterwards.
4. In a program without log handlers Python writes warnings to stderr (`logging.lastResort`). They are still written
   there, although this handler exists.
"""

import logging
import threading
from collections import deque
from types import TracebackType
from typing import Final, Self, cast

from ...values import printable
from .collector_messages import LogAnswer, LogLevel, LogLine

MOST_LINES: Final = 1000
LONGEST_LINE: Final = 2000
_LOGGER: Final = "busway"
_NUMBERS: Final = {"debug": logging.DEBUG, "info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}


class CollectorLog(logging.Handler):
    """Log handler that keeps the latest messages of busway's loggers; installed while its ``with`` block lasts."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._kept: deque[LogLine] = deque(maxlen=MOST_LINES)
        self._count = 0
        self._guard = threading.Lock()
        self._level_before = logging.NOTSET

    def __enter__(self) -> Self:
        logger = logging.getLogger(_LOGGER)
        self._level_before = logger.level
        if logger.getEffectiveLevel() > logging.INFO:
            logger.setLevel(logging.INFO)
        logger.addHandler(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        logger = logging.getLogger(_LOGGER)
        logger.removeHandler(self)
        logger.setLevel(self._level_before)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a log message for the page. In a program without log handlers, also write warnings to stderr.

        Called by `logging`, in any thread.
        """
        if not logging.getLogger().handlers and logging.lastResort and record.levelno >= logging.lastResort.level:
            logging.lastResort.handle(record)
        try:
            text = printable(record.getMessage())[:LONGEST_LINE]
        except Exception:  # of the arguments' own `__str__`, as in every handler; `handleError` prints it to stderr
            self.handleError(record)
            return
        with self._guard:
            self._count += 1
            line = LogLine(
                number=self._count,
                at=int(record.created * 1000),
                level=_level_of(record.levelno),
                source=record.name.removeprefix(f"{_LOGGER}."),
                text=text,
            )
            self._kept.append(line)

    def lines(self, limit: int, level: LogLevel, search: str) -> LogAnswer:
        """Return the kept log messages that match, the newest first, and how many messages are no longer kept.

        Args:
            limit: largest number of messages to return.
            level: the lowest level to return.
            search: words separated by spaces; source and text of a message must contain all of them, in upper or lower
                case. Empty: all messages match.
        """
        with self._guard:
            kept, count = list(self._kept), self._count
        words = search.casefold().split()
        fit = [
            line
            for line in reversed(kept)
            if _NUMBERS[line.level] >= _NUMBERS[level]
            and all(word in f"{line.source} {line.text}".casefold() for word in words)
        ]
        return LogAnswer(lines=fit[:limit], dropped=count - len(kept))


def _level_of(number: int) -> LogLevel:
    found = [name for name, least in _NUMBERS.items() if number >= least]
    return cast("LogLevel", found[-1] if found else "debug")
