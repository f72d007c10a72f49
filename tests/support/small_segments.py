"""``busway`` with a store whose segments are small, so that they end and are sealed all the time.

python small_segments.py BYTES ARGUMENT…
"""

import sys

from busway.apps.collector.store import writer
from busway.cli import main


def with_segments_of(size: int) -> None:
    """Have segments end after so many bytes where nothing else is said."""
    defaults = list(writer.StoreOptions.__init__.__defaults__ or ())
    defaults[-2] = size
    writer.StoreOptions.__init__.__defaults__ = tuple(defaults)


if __name__ == "__main__":
    with_segments_of(int(sys.argv.pop(1)))
    main()
