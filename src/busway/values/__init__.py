"""Conversion between registers and numbers, strings and bits, and the notations of addresses.

==============  =======================================================================
`types`         types by name, and the functions that most callers need
`numbers`       integers, floats, binary-coded decimals
`texts`         strings
`bits`          registers as bits
`orders`        byte and register orders
`addresses`     ``4x1``, ``40001``, ``holding:0x10``, ``%MW10``
`printable`     text of devices and certificates, fit for a terminal and a log
`refusal`       the sentence with which a value is refused
==============  =======================================================================
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
