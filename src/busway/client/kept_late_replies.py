"""Late replies that may still come when a serial link is closed, kept for the next link to the same endpoint.

A late reply reaches the port or the converter even if the link that asked is closed: a program that opens and closes a
link for each reading would take it for the answer to its next request. Knows links by URL; knows no frame.

1. The outstanding replies of a closed link are kept, and passed to the next link to the same URL when it connects.
2. So they outlive links, and are forgotten at the end of the process.
"""

import threading
from collections import OrderedDict
from typing import Final

from ..session.late_replies import Doubts

KEPT_AT_MOST: Final = 1024
"""Most endpoints that are remembered; the one closed first is forgotten first."""


class KeptDoubts:
    """The late replies that may still come on serial lines whose links were closed, by URL; thread-safe."""

    def __init__(self) -> None:
        self._by_url: OrderedDict[str, Doubts] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, url: str, doubts: Doubts) -> None:
        """Store the late replies that may still come on the line of a closed link to ``url``."""
        if not doubts.is_owed:
            return
        with self._lock:
            kept = self._by_url.pop(url, None)
            if kept is not None:
                kept.add(doubts)
                doubts = kept
            self._by_url[url] = doubts
            if len(self._by_url) > KEPT_AT_MOST:
                self._by_url.popitem(last=False)

    def hand_over(self, url: str, doubts: Doubts) -> None:
        """Move the late replies stored for ``url`` to ``doubts``, the record of a new link to it."""
        if not self._by_url:
            return
        with self._lock:
            kept = self._by_url.pop(url, None)
        if kept is not None:
            doubts.add(kept)

    def clear(self) -> None:
        """Forget the late replies of all lines, for tests that reuse a URL for another line."""
        with self._lock:
            self._by_url.clear()


KEPT: Final = KeptDoubts()
"""The store of this process."""
