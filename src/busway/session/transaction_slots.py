"""The limit of requests that a server works on at once (Messaging on TCP/IP V1.0b §4.4.2.1)."""


class TransactionSlots:
    """Limit of how many requests may be processed at once, 1…16: NumberMaxOfServerTransaction (TCP/IP §4.4.2.1).

    Each connection has slots of its own, or all connections of a server share them: then the limit is for all
    together. Those who take a slot add to ``used``, and subtract again; nothing is enforced here.

    Args:
        limit: the most requests.
        of_each_connection: whether each connection has slots of its own. All are given this object, of which no slot is
            ever used, and a connection calls `taken` before its first request waits.
    """

    __slots__ = ("_of_each_connection", "limit", "used")

    def __init__(self, limit: int, *, of_each_connection: bool = False) -> None:
        self.limit: int = limit
        self.used: int = 0
        self._of_each_connection = of_each_connection

    def taken(self) -> "TransactionSlots":
        """Return the slots in which a connection counts its waiting requests; call it once for each connection."""
        return TransactionSlots(self.limit) if self._of_each_connection else self
