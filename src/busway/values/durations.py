"""Durations as people write them: ``500ms``, ``10s``, ``5m``, ``1h``."""

import re
from typing import Final

_DURATION: Final = re.compile(r"(\d{1,9}(?:\.\d{1,9})?|\.\d{1,9})\s*(ms|s|min|m|h|d|w)?")
_SECONDS: Final = {"ms": 0.001, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}


def duration(text: str, *, bare: bool = False) -> float | None:
    """Return the seconds that a text such as ``10s`` or ``500ms`` means; None if the text is no duration.

    Args:
        text: one number without a sign, of up to 9 digits and 9 decimals, and one unit in small letters: ms, s, m or
            min, h, d (days), w (weeks). ``1h30m`` is no duration.
        bare: whether a number without a unit is taken as seconds; otherwise the result for it is None.
    """
    match = _DURATION.fullmatch(text.strip())
    if match is None or (match[2] is None and not bare):
        return None
    return float(match[1]) * _SECONDS[match[2] or "s"]
