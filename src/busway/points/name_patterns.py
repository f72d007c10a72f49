"""Patterns of names: which devices and points a pattern such as ``meter-7/*`` means.

Knows texts only.
"""

from fnmatch import fnmatchcase

__all__ = ["is_meant"]


def is_meant(name: str, pattern: str) -> bool:
    """Whether a pattern means a name: that of a device, of a point, or both as ``device/point``.

    ``*`` stands for any characters, ``?`` for one. A bracket is a bracket: names of PLCs have indices in them.
    """
    return fnmatchcase(name, pattern.replace("[", "[[]"))
