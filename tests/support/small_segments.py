"""``busway`` with a store whose segments are small, so that they end, are sealed and dropped all the time.

A day of ``keep_days`` has nine seconds.

python small_segments.py BYTES ARGUMENT…
"""

import sys

from busway.apps.collector import collector
from busway.apps.collector.store import writer
from busway.apps.collector.store.retention import Retention
from busway.cli import main


def with_segments_of(size: int) -> None:
    """Have segments end after so many bytes where nothing else is said."""
    defaults = list(writer.StoreOptions.__init__.__defaults__ or ())
    defaults[-2] = size
    writer.StoreOptions.__init__.__defaults__ = tuple(defaults)


def small_retention(age: float | None, size: int | None) -> Retention:
    """A ten-thousandth of the age that is wanted."""
    return Retention(None if age is None else age / 10_000, size)


if __name__ == "__main__":
    with_segments_of(int(sys.argv.pop(1)))
    vars(collector)["Retention"] = small_retention
    main()
