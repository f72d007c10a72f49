"""Text of a number with its noun in singular or plural, such as ``3 coils``.

Knows regular nouns only.
"""

from typing import Final, Literal

_PLURAL: Final = {"is": "are", "was": "were", "follows": "follow"}


def counted(count: int, noun: str, verb: Literal["", "is", "was", "follows"] = "") -> str:
    """Return a number with its noun: ``1 coil``, ``3 coils``, ``2 retries``, ``1 byte is``, ``2 bytes are``.

    Args:
        count: how many there are, 0 or more.
        noun: an English noun in the singular, whose plural has an added s, or ``ries`` for ``ry``.
        verb: a verb to append, in the singular; it becomes plural with the noun. Empty for none.
    """
    if count == 1:
        return f"1 {noun} {verb}".rstrip()
    nouns = f"{noun[:-1]}ies" if noun.endswith("ry") else f"{noun}s"
    return f"{count} {nouns} {_PLURAL.get(verb, '')}".rstrip()
