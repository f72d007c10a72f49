"""Opens a serial port that may be missing for now, with pauses between the attempts.

Knows how often; the waiting itself is handed in, so that a test waits in its own way.

1. The first pause is short: an adapter that is replugged is back within a second. Each further one doubles, up to a
   most; a port that is gone for hours costs one attempt per ``most`` seconds.
2. Only what may be different later is tried again: `LinkDown` is, `ConfigError` is not.
"""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TypeVar

from ...errors import ConfigError, LinkDown

Port = TypeVar("Port")


@dataclass(frozen=True, slots=True)
class ReopenPolicy:
    """How long to wait between attempts to open a serial port that is missing.

    Attributes:
        first: seconds after the first failure, 0.01…60.
        most: seconds that no pause exceeds, ``first``…3600.
        attempts: how many failures in a row end it; None waits for ever.
    """

    first: float = 0.1
    most: float = 2.0
    attempts: int | None = None

    def __post_init__(self) -> None:
        if not 0.01 <= self.first <= 60:
            raise ConfigError(f"must be 0.01…60 seconds, not {self.first:g}", key="first")
        if not self.first <= self.most <= 3600:
            raise ConfigError(f"must be {self.first:g}…3600 seconds, not {self.most:g}", key="most")
        if self.attempts is not None and self.attempts < 1:
            raise ConfigError(f"must be at least 1, not {self.attempts}", key="attempts")

    def pause(self, failures: int) -> float | None:
        """Return the seconds to wait after so many failures in a row (from 1); None to give up."""
        if self.attempts is not None and failures >= self.attempts:
            return None
        return min(self.first * 2.0 ** min(failures - 1, 32), self.most)


def _ignore(_error: LinkDown, _pause: float) -> None:
    """Do nothing after a failed attempt to open a port: the default for that callback."""


async def open_when_there(
    opener: Callable[[], Awaitable[Port]],
    policy: ReopenPolicy,
    *,
    waiting: Callable[[LinkDown, float], None] = _ignore,
    sleep: Callable[[float], Awaitable[object]] | None = None,
) -> Port:
    """Open a serial port; if it is missing, wait as long as the policy allows. Cancel it to stop waiting.

    Args:
        opener: opens the port once, for example ``lambda: SerialConnection.open(…)``.
        policy: the pauses.
        waiting: called with each failure and the pause after it, in seconds.
        sleep: waits.

    Raises:
        LinkDown: the last failure, when the policy's attempts are used up.
        ConfigError: what waiting does not change.
    """
    if sleep is None:
        import asyncio  # here: blocking programs do without it

        sleep = asyncio.sleep
    failures = 0
    while True:
        try:
            return await opener()
        except LinkDown as error:
            failures += 1
            pause = policy.pause(failures)
            if pause is None:
                raise
            waiting(error, pause)
        await sleep(pause)
