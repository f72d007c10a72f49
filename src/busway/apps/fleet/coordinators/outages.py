"""Logs when the watches of a coordinator cannot follow its table, and when they follow it again.

Knows no engine. One outage is logged once, no matter how many watches it ends and how many tries fail.
"""

import logging

_log = logging.getLogger("busway.fleet")


class OutageLog:
    """Logs the times in which the shared table cannot be followed: one line at the begin, and one at the end."""

    def __init__(self) -> None:
        self._is_lost = False

    def lost(self, reason: str) -> None:
        """Record that a watch cannot follow the table, and log it unless the outage was logged before.

        Args:
            reason: what the coordinator's server or file reports, without secrets.
        """
        if not self._is_lost:
            _log.warning("the table of the zone cannot be followed, and is tried again: %s", reason)
        self._is_lost = True

    def complete(self) -> None:
        """Record that a watch has shown all entries of the table; if there was an outage, its end is logged."""
        if self._is_lost:
            _log.warning("the table of the zone is followed again")
        self._is_lost = False
