"""Finds the known name that an unknown one was probably meant to be, for the hint "is it …?" in errors.

Knows names; knows no option and no file. The words of the hint are those of each error.
"""

from collections.abc import Iterable


def similar_name(unknown: str, known: Iterable[str], at_least: float = 0.6) -> str | None:
    """Return the known name that is most similar to an unknown one; None if none is similar enough.

    Args:
        unknown: the name that is not known.
        known: the names that could have been meant.
        at_least: the similarity, 0…1, from which on a name counts as meant: 0.75 where many names share their letters,
            as ``profile`` and ``file`` do.
    """
    from difflib import get_close_matches  # here: only errors need it

    return next(iter(get_close_matches(unknown, list(known), 1, at_least)), None)
