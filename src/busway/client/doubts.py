"""What closed links were owed, kept for the next link to the same endpoint.

A unit that owes a reply gives it to the port or to the converter, whoever has it open by then: a program that opens and
closes a link for each reading would take it for the answer to its next request. Knows links by URL; knows no frame.

1. What a link is owed when it is closed is kept, and handed to the next one to the same URL when that connects.
2. So doubt outlives links, and ends with the process.
"""

import threading
from collections import OrderedDict
from typing import Final

from ..session.doubt import Doubts

KEPT_AT_MOST: Final = 1024
"""Endpoints whose doubts are kept; the one that was closed first goes first."""


class KeptDoubts:
    """The doubts of closed links; safe from any thread."""

    def __init__(self) -> None:
        self._by_url: OrderedDict[str, Doubts] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, url: str, doubts: Doubts) -> None:
        """A link to ``url`` was closed."""
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
        """A link to ``url`` has connected: its ``doubts`` take over what is kept."""
        if not self._by_url:
            return
        with self._lock:
            kept = self._by_url.pop(url, None)
        if kept is not None:
            doubts.add(kept)

    def clear(self) -> None:
        """Forget what is kept: other units are behind the same URLs now, as in a test."""
        with self._lock:
            self._by_url.clear()


KEPT: Final = KeptDoubts()
"""Those of this process."""
