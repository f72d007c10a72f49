"""Patterns of names: which devices and points a pattern such as ``meter-7/*`` means.

Knows texts only.
"""

from fnmatch import fnmatchcase

__all__ = ["is_meant"]


def is_meant(name: str, pattern: str) -> bool:
    """Whether a whole name matches a pattern. A name is that of a device, of a point, or both as ``device/point``.

    ``*`` stands for any number of characters, also ``/``; ``?`` for exactly one. Upper and lower case differ. Brackets
    stand for themselves, because names of PLC points contain indices.
    """
    return fnmatchcase(name, pattern.replace("[", "[[]"))
