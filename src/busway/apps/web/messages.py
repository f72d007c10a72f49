"""Base classes for the requests and responses of all pages, errors, and the form of values in JSON.

A number that JSON cannot represent is sent as a text: ``"NaN"``, ``"Infinity"``, ``"-Infinity"``. An integer that a
browser cannot hold exactly (beyond ±2**53) is sent as a text, too.
"""

import math
from typing import Any, ClassVar, Final

from pydantic import BaseModel, ConfigDict, Field

Scalar = bool | int | float | str | None
Plain = Scalar | list[Scalar]
"""The value of a point as JSON: a single value, or a list of single values."""

_LARGEST_EXACT: Final = 2**53


class Asked(BaseModel):
    """Base class of the data classes for the body or query of a request to the page's API."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid")


class Answer(BaseModel):
    """Base class of the data classes for the body of a response of the page's API."""


class Failure(Answer):
    """Response: why a request to the page's API failed."""

    error: str = Field(description="A sentence.")


class CallerAnswer(Answer):
    """Response: name and role of the caller."""

    name: str
    role: str = Field(description="view, operate or configure; each includes those before it.")


def plain_value(value: Any) -> Plain:
    """Return a value in a form that JSON can represent (`Plain`).

    NaN, infinities and integers beyond ±2**53 become texts; bytes become hexadecimal text; values of unknown classes
    become ``str(value)``. The items of a list or tuple are treated likewise; a list within a list becomes a text.
    """
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return value
    if isinstance(value, int):
        return value if -_LARGEST_EXACT <= value <= _LARGEST_EXACT else str(value)
    if isinstance(value, float):
        if math.isfinite(value):
            return value
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if isinstance(value, bytes | bytearray):
        return value.hex(" ")
    if isinstance(value, list | tuple):
        return [one if not isinstance(one := plain_value(each), list) else str(one) for each in value]
    return str(value)
