"""What can be set about a server and its listeners, beside the sockets' own parameters."""

from dataclasses import dataclass

from ..errors import ConfigError


@dataclass(frozen=True, slots=True)
class ListenerParameters:
    """How a listener treats its connections.

    Attributes:
        backlog: connections that the system may hold before they are accepted.
        max_connections: connections at once; the next newcomer takes the place of the oldest unused one.
        write_buffer: bytes of replies that may wait for a client that does not take them; beyond, nothing more is
            read from it until half of them have gone.
        single_adu_segments: whether each reply is written by itself, as Messaging on TCP/IP V1.0b §4.3.2 advises;
            otherwise replies to requests that arrived together leave together.
    """

    backlog: int = 128
    max_connections: int = 64
    write_buffer: int = 65_536
    single_adu_segments: bool = False

    def __post_init__(self) -> None:
        for key, low, high in (
            ("backlog", 1, 65_535),
            ("max_connections", 1, 1_000_000),
            ("write_buffer", 1024, 1 << 30),
        ):
            if not low <= getattr(self, key) <= high:
                raise ConfigError(f"must be {low}…{high}, not {getattr(self, key)}", key=key)
