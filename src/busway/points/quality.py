"""How sure a value is: its quality, and the reason where it is not good. Knows nothing else."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any


class Quality(IntEnum):
    """How sure a value is; the larger, the worse."""

    GOOD = 0
    UNCERTAIN = 1
    """There is a value, but it may be wrong: out of its valid range, held, or of a clock that is not set."""
    BAD = 2
    """There is no value."""

    @property
    def label(self) -> str:
        """``good``, ``uncertain``, ``bad``."""
        return self.name.lower()


@dataclass(frozen=True, slots=True)
class Flaw:
    """Why a value is not good.

    Attributes:
        quality: uncertain or bad.
        reason: in words, one of a few for each point, so that a store can keep a number for it.
    """

    quality: Quality
    reason: str


@dataclass(frozen=True, slots=True)
class Reading:
    """What a read says of one point.

    Attributes:
        value: in the unit of measure; None where the quality is bad.
        quality: how sure it is.
        reason: why it is not good; empty where it is.
    """

    value: Any  # what the point's type says
    quality: Quality = Quality.GOOD
    reason: str = ""
