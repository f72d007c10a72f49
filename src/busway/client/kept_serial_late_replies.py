"""Late replies that may still come when a serial link is closed, kept for the next link to the same endpoint.

A late reply reaches the serial port or the converter even if the link that sent the request is closed: a program that
opens and closes a link for each reading would take the late reply for the answer to its next request. Knows links by
URL; knows no frame.

1. What is known about late replies of a closed link is kept, and that its line echoes. The next link to the same URL
   gets it when it connects.
2. It is forgotten at the end of the process.
"""

import threading
from collections import OrderedDict
from typing import Final

from ..session.serial_late_replies import LateReplies

KEPT_AT_MOST: Final = 1024
"""Most endpoints that are remembered; beyond that, the one whose link was closed longest ago is forgotten."""


class KeptLateReplies:
    """The records of late replies that closed serial links may still get, by URL of the link; thread-safe."""

    def __init__(self) -> None:
        self._by_url: OrderedDict[str, LateReplies] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, url: str, late_replies: LateReplies) -> None:
        """Store the record of a closed link to ``url``, added to an earlier one.

        Does nothing if no late reply can come any more, and the line does not echo.
        """
        if not (late_replies.is_owed or late_replies.echoes):
            return
        with self._lock:
            kept = self._by_url.get(url)
            if kept is late_replies:
                return  # closing was interrupted, and is repeated
            if kept is not None:
                kept.add(late_replies)
                late_replies = kept
            self._by_url[url] = late_replies
            self._by_url.move_to_end(url)
            if len(self._by_url) > KEPT_AT_MOST:
                self._by_url.popitem(last=False)

    def hand_over(self, url: str, late_replies: LateReplies) -> None:
        """Add what is stored for ``url`` to ``late_replies``, the record of a new link to that URL, and forget it."""
        if not self._by_url:
            return
        with self._lock:
            kept = self._by_url.get(url)
            if kept is not None:
                late_replies.add(kept)  # first: an interrupt must not lose it
                del self._by_url[url]

    def clear(self) -> None:
        """Forget everything that is stored; for tests, which use the same URL for another line."""
        with self._lock:
            self._by_url.clear()


KEPT: Final = KeptLateReplies()
"""The record of late replies that all serial links of this process use."""
