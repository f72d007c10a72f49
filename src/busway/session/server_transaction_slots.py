"""The slots that limit how many requests a server works on at once: NumberMaxOfServerTransaction (TCP/IP §4.4.2.1)."""


class ServerTransactionSlots:
    """Limit of how many requests may be processed at once, 1…16: NumberMaxOfServerTransaction (TCP/IP §4.4.2.1).

    Each connection has slots of its own, or all connections of a server share them. This object only counts: the user
    adds 1 to ``used`` for each request, and subtracts it again.

    Args:
        limit: the most requests.
        of_each_connection: whether each connection has slots of its own; if not, all connections share this object.
    """

    __slots__ = ("_of_each_connection", "limit", "used")

    def __init__(self, limit: int, *, of_each_connection: bool = False) -> None:
        self.limit: int = limit
        self.used: int = 0
        self._of_each_connection = of_each_connection

    def taken(self) -> "ServerTransactionSlots":
        """Return the slots that a new connection has to use: new ones, or this object if all connections share it."""
        return ServerTransactionSlots(self.limit) if self._of_each_connection else self
