"""Counts of answered requests and their durations, by class of client, unit, function and exception code.

Knows numbers; knows no responder, no clock and nothing of how numbers are shown.

1. The thread that answers requests counts them; any thread may read. A number read is at most one request late.
2. The number of series is bounded, whatever clients ask: functions outside the table count as ``other``, and so do the
   units of new series once there are `MAX_SERIES`.
"""

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable
from enum import Enum
from typing import Final

from ...codes import ExceptionCode, FunctionCode

OTHER: Final = "other"
"""Label value of units and functions that have no label value of their own."""
NO_EXCEPTION: Final = "none"
"""Label value of replies that are no exception."""
MAX_SERIES: Final = 4096
"""Number of series of the counter of requests from which on new series have the unit ``other``: 256 units · 16 series.

Only series with the unit ``other`` are added then, which are few.
"""
BUCKETS: Final = (0.000_01, 0.000_1, 0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
"""Upper bounds of the histogram in seconds: a reply of this process takes microseconds, one of a gateway seconds."""

_KNOWN_EXCEPTIONS: Final = frozenset(int(code) for code in ExceptionCode)


class PeerClass(Enum):
    """Classes of clients that the metrics count separately, as values of a label."""

    PRIORITY = "priority"
    """A priority host."""
    OTHER = "other"
    """Any other host."""
    LINE = "line"
    """The master of a serial line."""


class Unanswered(Enum):
    """Reasons why a request got no reply, as values of a label of the metrics."""

    BROADCAST = "broadcast"
    """A broadcast on a serial line; counted for each unit that it reached."""
    SILENT = "silent"
    """The responder decided to send no reply, or the unit is in listen-only mode."""
    GONE = "gone"
    """The client disconnected before the reply was there."""


class Series:
    """One counter of requests: those with the same values of all labels.

    Attributes:
        peer_class, unit, function, exception: the values of the labels.
        count: number of answered requests.
    """

    __slots__ = ("count", "exception", "function", "peer_class", "unit")

    def __init__(self, peer_class: str, unit: str, function: str, exception: str) -> None:
        self.peer_class: str = peer_class
        self.unit: str = unit
        self.function: str = function
        self.exception: str = exception
        self.count: int = 0


class Durations:
    """Histogram of how long requests of one function took.

    Attributes:
        function: value of the label ``function``.
        counts: number of replies in each bucket of `BUCKETS`, not cumulative; the last are those above every bound.
        total: seconds of all replies together.
    """

    __slots__ = ("counts", "function", "total")

    def __init__(self, function: str) -> None:
        self.function: str = function
        self.counts: list[int] = [0] * (len(BUCKETS) + 1)
        self.total: float = 0.0

    def add(self, seconds: float, count: int = 1) -> None:
        """Add ``count`` requests that took ``seconds`` each."""
        self.counts[bisect_left(BUCKETS, seconds)] += count
        self.total += seconds * count


class RequestTally:
    """Counters of the requests that a server or gateway has answered, by labels, and how long they took.

    Args:
        functions: function codes that get a label value of their own.
        units: whether units are counted separately; if not, the label ``unit`` is empty.
    """

    def __init__(self, functions: Iterable[int] = tuple(FunctionCode), *, units: bool = True) -> None:
        self._functions = frozenset(functions)
        self._units = units
        self._series: dict[tuple[str, str, str, str], Series] = {}
        self._durations: dict[str, Durations] = {}
        self._unanswered: Counter[Unanswered] = Counter()

    # What is counted.

    def series(self, peer_class: PeerClass, unit: int, function: int, exception: int | None = None) -> Series:
        """Return the counter for these label values, created at its first use; the caller may keep it.

        Args:
            peer_class: class of the client.
            unit: unit identifier, 0…255.
            function: function code, 1…127.
            exception: exception code of the reply; None for other replies.
        """
        unit_label = str(unit) if self._units else ""
        labels = (peer_class.value, unit_label, self._function(function), _exception(exception))
        found = self._series.get(labels)
        if found is None and len(self._series) >= MAX_SERIES:
            labels = (labels[0], OTHER, *labels[2:])
            found = self._series.get(labels)
        if found is None:
            found = self._series[labels] = Series(*labels)
        return found

    def durations(self, function: int) -> Durations:
        """Return the histogram of durations of a function code, created at its first use.

        Function codes that are not among ``functions`` of the tally share one histogram.
        """
        label = self._function(function)
        found = self._durations.get(label)
        if found is None:
            found = self._durations[label] = Durations(label)
        return found

    def unanswered(self, why: Unanswered) -> None:
        """Count a request that got no reply, and why."""
        self._unanswered[why] += 1

    # What is read, from any thread.

    def all_series(self) -> list[Series]:
        """Return the counters of all label values so far; the objects go on counting."""
        return list(self._series.copy().values())

    def all_durations(self) -> list[Durations]:
        """Return the histograms of durations of all functions so far; the objects go on counting."""
        return list(self._durations.copy().values())

    def unanswered_counts(self) -> dict[Unanswered, int]:
        """Return the number of requests without a reply for every reason, 0 included."""
        return {why: self._unanswered[why] for why in Unanswered}

    def total(self) -> int:
        """Return the number of requests answered so far."""
        return sum(series.count for series in self.all_series())

    def _function(self, code: int) -> str:
        return str(code) if code in self._functions else OTHER


def _exception(code: int | None) -> str:
    """Return an exception code as text for a label: two hexadecimal digits, as in documents.

    It is `NO_EXCEPTION` for None, and `OTHER` for a code that `ExceptionCode` does not have.
    """
    if code is None:
        return NO_EXCEPTION
    return f"{code:02X}" if code in _KNOWN_EXCEPTIONS else OTHER
