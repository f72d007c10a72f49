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
        ttl: seconds for which a lease holds, counted from when its last successful renewal was sent, 3…300.
        renew: seconds between two renewals, above 0 and at most a third of ``ttl``.
        guard: seconds that the owner stops earlier, and another collector begins later, so that clocks may drift; from
            a hundredth to a quarter of ``ttl``.
        answer: seconds after which the outcome of a change without an answer is unknown; at most a third of ``ttl``.

    Raises:
        ConfigError: a value is out of its range.
    """

    ttl: float = 15.0
    renew: float = 3.0
    guard: float = 1.0
    answer: float = 2.5

    @classmethod
    def lasting(cls, ttl: float, guard: float | None = None) -> "LeaseTimes":
        """Return the times of leases that hold for ``ttl`` seconds, all others in the proportion of the defaults.

        Args:
            ttl: seconds for which a lease holds, 3…300.
            guard: seconds of the guard, from a hundredth to a quarter of ``ttl``; None for the proportion of the
                defaults.

        Raises:
            ConfigError: a value is out of its range.
        """
        usual = cls()
        part = ttl / usual.ttl
        guard = round(part * usual.guard, 3) if guard is None else guard
        return cls(ttl, round(part * usual.renew, 3), guard, round(part * usual.answer, 3))

    @property
    def longest_transaction(self) -> float:
        """The most seconds that a transaction may take, so that two renewals may fail before a link pauses."""
        return self.ttl - self.guard - 2 * self.renew

    @property
    def silence(self) -> float:
        """Seconds for which a lease must not change before another collector may take its shard."""
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
        """Return when an owner must have ended all transactions if its last confirmed renewal was sent at ``asked``."""
        return asked + self.ttl - self.guard

    def free_at(self, seen: float) -> float:
        """Return from when a shard (group of links) may be taken from an owner that is silent since ``seen``.

        Args:
            seen: when the lease of the shard was last seen to change, by the clock of the collector that wants the
                shard.
        """
        return seen + self.silence


@dataclass(frozen=True, slots=True, order=True)
class Epoch:
    """The number of one ownership of a shard (group of links); each later ownership has a greater number.

    Attributes:
        generation: raised by an operator who restores the coordinator from a backup, so that epochs never go back.
        revision: revision of the table entry that took the lease; more if an earlier epoch is not below that.
    """

    generation: int
    revision: int

    def __str__(self) -> str:
        return f"{self.generation}.{self.revision}"

    def above(self, other: "Epoch | None") -> "Epoch":
        """Return an epoch above another one: this epoch if it is above, else the one that follows the other.

        A coordinator that was restored may count revisions from a lower number.
        """
        return self if other is None or self > other else Epoch(other.generation, other.revision + 1)
