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
        frame_timeout: seconds from the first byte of a request to its last; a client that begins one and falls silent
            is closed then, so that it does not hold a place for ever. None waits for ever.
    """

    backlog: int = 128
    max_connections: int = 64
    write_buffer: int = 65_536
    single_adu_segments: bool = False
    frame_timeout: float | None = 10.0

    def __post_init__(self) -> None:
        for key, low, high in (
            ("backlog", 1, 65_535),
            ("max_connections", 1, 1_000_000),
            ("write_buffer", 1024, 1 << 30),
        ):
            if not low <= getattr(self, key) <= high:
                raise ConfigError(f"must be {low}…{high}, not {getattr(self, key)}", key=key)
        if self.frame_timeout is not None and not 0.001 <= self.frame_timeout <= 3600:
            raise ConfigError(f"must be 0.001…3600, not {self.frame_timeout:g}", key="frame_timeout")
