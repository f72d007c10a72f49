"""Names of value types, orders and tables for type checkers, so that a wrong name is found before the program runs.

Knows texts only; `types`, `orders` and `codes.Table` say what they mean, and a test keeps the lists equal.
"""

from typing import Literal, TypeAlias

IntegerName: TypeAlias = Literal[
    "int16", "uint16", "int32", "uint32", "int48", "uint48", "int64", "uint64", "bcd16", "bcd32", "bcd64",
    "i16", "u16", "i32", "u32", "i64", "u64",
]  # fmt: skip
"""Names of the types whose values are ``int``."""

FloatName: TypeAlias = Literal["float16", "float32", "float64", "f16", "f32", "f64"]
"""Names of the types whose values are ``float``."""

Order: TypeAlias = Literal[
    "AB", "BA",
    "ABCD", "BADC", "CDAB", "DCBA",
    "ABCDEF", "BADCFE", "EFCDAB", "FEDCBA", "CDABEF", "DCBAFE", "ABEFCD", "BAFEDC",
    "ABCDEFGH", "BADCFEHG", "CDABGHEF", "DCBAHGFE", "EFGHABCD", "FEHGBADC", "GHEFCDAB", "HGFEDCBA",
    "big", "little", "word-swapped", "byte-swapped",
]  # fmt: skip
"""Names of the orders of bytes and registers (`busway.values.orders`)."""

IdentificationLevel: TypeAlias = Literal["basic", "regular", "extended"]
"""Names of the levels of device identification, which say how many objects are read (function 43/14)."""

TableName: TypeAlias = Literal["coils", "discrete_inputs", "input_registers", "holding_registers"]
"""Names of the four tables (`busway.codes.Table`)."""

WritableTableName: TypeAlias = Literal["coils", "holding_registers"]
"""Names of the tables that functions of Modbus write."""
