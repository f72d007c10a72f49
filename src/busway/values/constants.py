"""Value types as constants: with them a type checker knows what a read returns.

>>> busway.FLOAT32                                         # doctest: +SKIP
>>> link.unit(1).read("4x1", busway.FLOAT32)               # a float
>>> link.unit(1).read("4x9", busway.string(16))            # a str

They have the byte order ``ABCD``; another order is named beside them: ``read("4x1", busway.FLOAT32, order="CDAB")``.
"""

from typing import Any, Final, Literal

from .types import ValueType, value_type

INT16: Final[ValueType[int]] = value_type("int16")
UINT16: Final[ValueType[int]] = value_type("uint16")
INT32: Final[ValueType[int]] = value_type("int32")
UINT32: Final[ValueType[int]] = value_type("uint32")
INT64: Final[ValueType[int]] = value_type("int64")
UINT64: Final[ValueType[int]] = value_type("uint64")
FLOAT16: Final[ValueType[float]] = value_type("float16")
FLOAT32: Final[ValueType[float]] = value_type("float32")
FLOAT64: Final[ValueType[float]] = value_type("float64")
BCD16: Final[ValueType[int]] = value_type("bcd16")
BCD32: Final[ValueType[int]] = value_type("bcd32")
BCD64: Final[ValueType[int]] = value_type("bcd64")
BITS: Final[ValueType[tuple[bool, ...]]] = value_type("bits")


def string(
    length: int, encoding: Literal["ascii", "latin-1", "utf-8"] = "ascii", padding: Literal["nul", "space"] = "nul"
) -> ValueType[str]:
    """Return the value type of a text of up to ``length`` bytes, two in each register.

    Args:
        length: bytes, 1…250.
        encoding: the encoding of its characters.
        padding: the character that fills the rest of the registers when a text is written: NUL or space.

    Raises:
        InvalidRequest: there is no such length, encoding or padding. Nothing was sent.
    """
    found: ValueType[Any] = value_type(f"string:{length}:{encoding}:{padding}")
    return found
