"""Conversion between registers and numbers, strings and bits, and the notations of addresses.

===============  ==============================================================================================
`addresses`      Parses data addresses as people write them, such as `40001` or `4x1`, into table and offset
`bits`           Conversion between registers and bits: a register as sixteen bits, single bits and bit fields
`caseless_enum`  Base of enums for options whose values are words, such as `even`: capitals are accepted too
`constants`      Value types as constants: with them a type checker knows what a read returns
`counts`         Text of a number with its noun in singular or plural, such as `3 coils`
`custom`         Conversion of registers by a `struct` format: `custom:>hHl` is three numbers in four registers
`durations`      Durations as people write them: `500ms`, `10s`, `5m`, `1h`
`names`          Names of value types, orders and tables for type checkers, which find wrong ones
`network`        Conversion between registers and network addresses: IPv4, IPv6, EUI-48 (MAC) and EUI-64
`numbers`        Conversion between registers and integers, floats and binary-coded decimals
`orders`         Byte orders, such as `CDAB`: of bytes and registers inside a value of 16, 32, 48 or 64 bits
`printable`      Makes text from devices and certificates safe to print on one line
`similar_names`  Finds the known name that an unknown one was probably meant to be, for the hint "is it …?"
`texts`          Conversion between registers and character strings
`types`          Value types by name, such as `float32`: how registers become values and back
`unfit_values`   Error messages for values that do not fit their type
===============  ==============================================================================================

Where it is decided: what a type name means, and how many registers it takes: `types`. In which order bytes are:
`orders`. What the address `40001` means: `addresses`. Which values fit a type: `numbers`, `texts`, `bits`, `network`;
how a refusal is worded: `unfit_values`. How long `5m` is: `durations`. Which name the hint "is it …?" of an error
names: `similar_names`.
"""

from .addresses import Address, format_address, parse_address
from .bits import parse_bit
from .orders import ORDERS
from .printable import printable
from .types import TYPE_NAMES, ValueType, decode, encode, parse_value, value_type

__all__ = [
    "ORDERS",
    "TYPE_NAMES",
    "Address",
    "ValueType",
    "decode",
    "encode",
    "format_address",
    "parse_address",
    "parse_bit",
    "parse_value",
    "printable",
    "value_type",
]
