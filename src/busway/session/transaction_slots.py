"""The limit of requests that a server works on at once (Messaging on TCP/IP V1.0b §4.4.2.1)."""


class TransactionSlots:
    """Limit of how many requests may be processed at once, 1…16: NumberMaxOfServerTransaction (TCP/IP §4.4.2.1).

    Each connection has an object of its own, or all connections of a server share one: then the limit is for all
    together. Those who take a slot add to ``used``, and subtract again; nothing is enforced here.
    """

    __slots__ = ("limit", "used")

    def __init__(self, limit: int) -> None:
        self.limit: int = limit
        self.used: int = 0
