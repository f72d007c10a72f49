"""Patterns of names: which devices and points a pattern such as ``meter-7/*`` means.

Knows texts only.
"""

from fnmatch import fnmatchcase

__all__ = ["is_meant", "point_pattern"]


def is_meant(name: str, pattern: str) -> bool:
    """Whether a whole name matches a pattern. A name is that of a device, of a point, or both as ``device/point``.

    ``*`` stands for any number of characters, also ``/``; ``?`` for exactly one. Upper and lower case differ. Brackets
    stand for themselves, because names of PLC points contain indices.
    """
    return fnmatchcase(name, pattern.replace("[", "[[]"))


def point_pattern(pattern: str) -> str:
    """Return the pattern of ``device/point`` that a pattern for points stands for: a device alone means all its points.

    ``meter-7`` becomes ``meter-7/*``; one with ``/``, and ``*``, which means all points of all devices, stay.
    """
    return pattern if "/" in pattern or pattern == "*" else f"{pattern}/*"
