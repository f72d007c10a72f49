"""The times of leases: until when an owner of a shard may send requests, and when another may take the shard.

All times are seconds of a clock that is never set and counts while the machine sleeps (``CLOCK_BOOTTIME``).
"""

from dataclasses import dataclass
from typing import Final

from ...errors import ConfigError

LONGEST_TTL: Final = 300
"""Seconds for which a lease may hold at most."""


@dataclass(frozen=True, slots=True)
class LeaseTimes:
    """How long a collector's right to poll (lease) holds and how often it is renewed; the same for all collectors.

    Attributes:
        ttl: seconds for which a lease holds, counted from when its last confirmed renewal was sent, 3…300.
        renew: seconds between two renewals, above 0 and at most a third of ``ttl``.
        guard: margin for clocks that drift, in seconds: the owner stops that much before the end of its lease, and
            another collector begins that much after it. From a hundredth to a quarter of ``ttl``.
        answer: seconds after which a change of the shared table without an answer counts as unknown; above 0 and at
            most a third of ``ttl``.

    Raises:
        ConfigError: a value is out of its range.
    """

    ttl: float = 15.0
    renew: float = 3.0
    guard: float = 1.0
    answer: float = 2.5

    @classmethod
    def lasting(cls, ttl: float, guard: float | None = None) -> "LeaseTimes":
        """Return the times of leases that hold for ``ttl`` seconds; other times have the defaults' ratio to ``ttl``.

        Args:
            ttl: seconds for which a lease holds, 3…300.
            guard: seconds of the guard, from a hundredth to a quarter of ``ttl``; None for the ratio of the defaults.

        Raises:
            ConfigError: a value is out of its range.
        """
        usual = cls()
        part = ttl / usual.ttl
        guard = round(part * usual.guard, 3) if guard is None else guard
        return cls(ttl, round(part * usual.renew, 3), guard, round(part * usual.answer, 3))

    @property
    def longest_transaction(self) -> float:
        """The longest permitted transaction, in seconds: two renewals can then fail before polling has to pause."""
        return self.ttl - self.guard - 2 * self.renew

    @property
    def silence(self) -> float:
        """Seconds for which a lease must have been unchanged before another collector may take its shard."""
        return self.ttl + self.guard

    def __post_init__(self) -> None:
        if not 3 <= self.ttl <= LONGEST_TTL:
            raise ConfigError(f"a lease holds for 3…{LONGEST_TTL} s, not {self.ttl:g}", key="ttl")
        if not 0 < self.renew <= self.ttl / 3:
            raise ConfigError(
                f"leases are renewed at least three times in their {self.ttl:g} s: {self.ttl / 3:g} s at most, "
                f"not {self.renew:g}",
                key="renew",
            )
        if not 0.01 * self.ttl <= self.guard <= self.ttl / 4:
            raise ConfigError(
                f"the guard is {0.01 * self.ttl:g}…{self.ttl / 4:g} s for a lease of {self.ttl:g} s, "
                f"not {self.guard:g}",
                key="guard",
            )
        if not 0 < self.answer <= self.ttl / 3:
            raise ConfigError(f"an answer is waited for up to {self.ttl / 3:g} s, not {self.answer:g}", key="answer")

    def deadline(self, asked: float) -> float:
        """Return until when an owner must have ended all transactions: the end of its lease, less the guard.

        Args:
            asked: when the last confirmed renewal of the lease was sent.
        """
        return asked + self.ttl - self.guard

    def free_at(self, seen: float) -> float:
        """Return from when another collector may take a shard (group of links) whose owner does not renew the lease.

        Args:
            seen: when the lease was last seen to change, by the clock of the collector that wants the shard.
        """
        return seen + self.silence
