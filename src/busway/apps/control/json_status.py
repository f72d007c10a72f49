"""Converts a status to data that JSON can represent: dataclasses become objects.

Knows types; knows no status, so a new field of a status appears in the JSON without a change here.
"""

import math
from collections.abc import Mapping, Set
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any


def plain(value: Any) -> Any:
    """Return a status as data for `json.dumps`: booleans, numbers, texts, lists, dictionaries and None.

    Dataclasses become dictionaries, and keys of dictionaries texts; tuples and sets become lists; enum members their
    value if it is a text, else their name in lower case; bytes hexadecimal text; dates and times (`datetime`) texts in
    ISO 8601; infinity and NaN None. Other objects become their ``str``.
    """
    if isinstance(value, Enum):
        return value.value if isinstance(value.value, str) else value.name.lower()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(plain(key)): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | Set):
        return [plain(each) for each in value]
    if isinstance(value, bytes | bytearray):
        return value.hex()
    return value.isoformat() if hasattr(value, "isoformat") else str(value)
