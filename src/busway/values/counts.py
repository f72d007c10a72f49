"""Says how many of something there are, as English does.

Knows regular nouns only.
"""


def counted(count: int, noun: str) -> str:
    """Return a number with its noun: ``1 coil``, ``3 coils``, ``2 retries``.

    Args:
        count: how many there are, 0 or more.
        noun: the word for one of them; a regular English noun.
    """
    if count == 1:
        return f"1 {noun}"
    return f"{count} {noun[:-1]}ies" if noun.endswith("ry") else f"{count} {noun}s"
