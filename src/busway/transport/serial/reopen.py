"""Opens a serial port that may be missing for now, with pauses between the attempts.

Knows how long to wait; the waiting itself is an argument, so that a test can replace it.

1. The first pause is short: an adapter that is replugged is back within a second. Each further pause is twice as long,
   up to ``most`` seconds, so a port that is missing for hours costs one attempt in ``most`` seconds.
2. After `LinkDown` it is tried again, after `ConfigError` not: that error does not pass.
"""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TypeVar

from ...errors import ConfigError, LinkDown
from ...options.ports import OpeningParameters

Port = TypeVar("Port")


@dataclass(frozen=True, slots=True)
class ReopenPolicy:
    """How long to wait between attempts to open a serial port that is missing.

    Attributes:
        first: seconds after the first failure, 0.01…60.
        most: longest pause in seconds, ``first``…3600.
        attempts: how many failures in a row end the attempts, 1 or more; None for no limit.
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

    @classmethod
    def of(cls, parameters: OpeningParameters) -> "ReopenPolicy":
        """Return the pauses that the options of a port set; the number of attempts has no limit."""
        return cls(first=parameters.reopen_first, most=parameters.reopen_most)

    def pause(self, failures: int) -> float | None:
        """Return the seconds to wait after ``failures`` failures in a row (1 or more); None to give up."""
        if self.attempts is not None and failures >= self.attempts:
            return None
        return min(self.first * 2.0 ** min(failures - 1, 32), self.most)


def _ignore(_error: LinkDown, _pause: float) -> None:
    """Do nothing; the default for the callback after a failed attempt."""


async def open_when_there(
    opener: Callable[[], Awaitable[Port]],
    policy: ReopenPolicy,
    *,
    waiting: Callable[[LinkDown, float], None] = _ignore,
    sleep: Callable[[float], Awaitable[object]] | None = None,
) -> Port:
    """Open a serial port and return it; while that fails with `LinkDown`, try again after the pauses of ``policy``.

    To stop waiting, cancel the task.

    Args:
        opener: opens the port once, for example ``lambda: SerialConnection.open(…)``.
        policy: the pauses, and how many attempts are made.
        waiting: called with each failure and the pause after it, in seconds.
        sleep: waits for a number of seconds; ``asyncio.sleep`` if left out.

    Raises:
        LinkDown: the last failure, when the attempts of the policy are used up.
        ConfigError: an error that does not pass by waiting.
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
