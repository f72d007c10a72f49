"""The epoch of an ownership: the number of a shard's owner, greater than that of every owner before."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, order=True)
class Epoch:
    """The number of one ownership of a shard (group of links); each later ownership has a greater number.

    Attributes:
        generation: generation number of the zone. An operator raises it after restoring the coordinator from a backup,
            so that later epochs are above all earlier ones.
        revision: revision of the table entry that took the lease; a higher number if an earlier epoch is not below it.
    """

    generation: int
    revision: int

    def __str__(self) -> str:
        return f"{self.generation}.{self.revision}"

    def above(self, other: "Epoch | None") -> "Epoch":
        """Return this epoch if it is above another one, else the other one with its revision raised by 1.

        A coordinator that was restored may count revisions from a lower number.

        Args:
            other: the last known epoch of the shard; None if there is none, so that this epoch is returned.
        """
        return self if other is None or self > other else Epoch(other.generation, other.revision + 1)
