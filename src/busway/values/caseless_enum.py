"""Base of options whose values are words, such as ``even``; capitals are accepted too."""

from enum import Enum
from typing import Self


class CaselessEnum(Enum):
    """Base of enums for options whose values are words: ``Parity("even")`` and ``Parity("EVEN")`` are the same member.

    The value of a member is the text of the option in lower case.
    """

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        if not isinstance(value, str) or value == value.lower():
            return None
        return cls(value.lower())
