"""``busway`` with a store whose segments are small, so that they end, are sealed and dropped all the time.

A day of ``keep_days`` has nine seconds, and it is looked at every second what is to be sealed or dropped. Few samples
wait while the store cannot be written, so that some are lost. The wall clock can be stepped (`shifted_clock`), and is
looked at twice a second.

python small_segments.py BYTES ARGUMENT…
"""

import sys

import shifted_clock

from busway.apps.collector import collector
from busway.apps.collector.store import committer as committer_module
from busway.apps.collector.store import writer
from busway.apps.collector.store.committer import Committer
from busway.apps.collector.store.retention import Retention
from busway.cli import main

MOST_WAITING = 1500
"""Values that wait while the store cannot be written: some of a second."""


def with_segments_of(size: int) -> None:
    """Have segments end after so many bytes where nothing else is said."""
    defaults = list(writer.StoreOptions.__init__.__defaults__ or ())
    defaults[-2] = size
    writer.StoreOptions.__init__.__defaults__ = tuple(defaults)


def small_retention(age: float | None, size: int | None) -> Retention:
    """A ten-thousandth of the age that is wanted."""
    return Retention(None if age is None else age / 10_000, size)


if __name__ == "__main__":
    assert shifted_clock.VARIABLE
    with_segments_of(int(sys.argv.pop(1)))
    vars(collector)["Retention"] = small_retention
    vars(collector)["CLOCK_EVERY"] = 0.5
    vars(committer_module)["UPKEEP"] = 1.0
    Committer.__init__.__kwdefaults__["most_waiting"] = MOST_WAITING
    main()
