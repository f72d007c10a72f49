"""Error messages for values that do not fit their type.

Knows how to show any value in a few characters; knows nothing about the types that refuse.
"""

from typing import Final

from ..errors import InvalidRequest

_SHOWN_CHARACTERS: Final = 60


def shown(value: object) -> str:
    """Return the ``repr`` of a value, cut after 60 characters to fit an error message.

    For an integer with too many digits for ``repr`` it is ``a number of thousands of digits``.
    """
    try:
        text = repr(value)
    except ValueError:  # Python refuses to print integers of some thousand digits
        return "a number of thousands of digits"
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}…"


def unfit(values: list[object], index: int, name: str, expects: str, hint: str = "") -> InvalidRequest:
    """Return the error for ``values[index]``, which does not fit a value type.

    Args:
        values: the values that were to be encoded; the message has the position if there are several.
        index: position of the one that does not fit, from 0.
        name: name of the value type.
        expects: what the type takes, in words.
        hint: more text for the end of the message.
    """
    place = f"values[{index}] = " if len(values) > 1 else ""
    return InvalidRequest(f"{place}{shown(values[index])} does not fit {name}, which takes {expects}{hint}")
