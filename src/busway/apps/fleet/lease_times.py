"""The times of leases: until when an owner of a shard may send requests, and when another may take the shard.

The clock is one that counts while the machine sleeps (``CLOCK_BOOTTIME``), and is never set.
"""

from dataclasses import dataclass

from ...errors import ConfigError


@dataclass(frozen=True, slots=True)
class LeaseTimes:
    """How long a collector's right to poll (lease) holds and how often it is renewed; the same for all collectors.

    Attributes:
        ttl: seconds for which a lease holds from the moment its last successful renewal was begun, 3…300.
        renew: seconds between two renewals, at most a third of ``ttl``.
        guard: seconds that a holder ends earlier and another one begins later; covers clocks that drift.
        answer: seconds after which the outcome of a change that was not answered is unknown.
    """

    ttl: float = 15.0
    renew: float = 3.0
    guard: float = 1.0
    answer: float = 2.5

    def __post_init__(self) -> None:
        if not 3 <= self.ttl <= 300:
            raise ConfigError(f"a lease holds for 3…300 s, not {self.ttl:g}", key="ttl")
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
        """Return when an owner must have ended all transactions if its last renewal was sent at ``asked``."""
        return asked + self.ttl - self.guard

    def free_at(self, seen: float) -> float:
        """Return when a shard (group of links) may be taken from its owner if its lease has not changed
        since ``seen``.
        """
        return seen + self.ttl + self.guard


@dataclass(frozen=True, slots=True, order=True)
class Epoch:
    """Number of an ownership of a shard (group of links); each later owner has a greater one.

    Attributes:
        generation: raised by an operator who restores the coordinator from a backup, so that epochs never go back.
        revision: the revision of the lease when it was taken; more where the owner before had as much or more.
    """

    generation: int
    revision: int

    def __str__(self) -> str:
        return f"{self.generation}.{self.revision}"

    def above(self, other: "Epoch | None") -> "Epoch":
        """Return this epoch, or the one next to another that is not below it: a server may count lower than before."""
        return self if other is None or self > other else Epoch(other.generation, other.revision + 1)
