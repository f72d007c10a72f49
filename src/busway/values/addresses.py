"""Parses data addresses as people write them, such as ``40001`` or ``4x1``, into table and offset.

On the wire an item is an offset 0…65535 in one of four tables; the data model numbers the same items 1…65536
(Application Protocol V1.1b3 §4.4). Manuals use either, and a value read one item off looks plausible, so every notation
here has a declared base, the number of its first item. Knows notations only; nothing here knows which items a device
has, or how many one request can cover.

======================================  ====  =====================================================================
notation                                base  meaning
======================================  ====  =====================================================================
``16`` (an ``int``)                     0     offset 16 of the table that the caller means
``4x17``                                1     ``0x`` coil, ``1x`` discrete input, ``3x`` input register,
                                              ``4x`` holding register, and the item's number in decimal
``40017``, ``400017`` (text)            1     the same with four or five digits: ``00001``…``09999``,
                                              ``10001``…, ``30001``…, ``40001``…49999; ``400001``…``465536``
``holding:16``, ``holding:0x10``        0     the table by name: ``coil``, ``discrete``, ``input``, ``holding``, or in
                                              full (``holding_registers``); the only place for hexadecimal
``%MW16``, ``%M16``                     0     a PLC's memory word (holding register) or memory bit (coil)
======================================  ====  =====================================================================

A register may be followed by a bit, 0 the least significant: ``4x17.3``, ``%MW16.15``.

Rules:

1. ``0x10`` is coil number 10, which is offset 9. It is never hexadecimal: ``0x`` is the prefix of coils as ``4x`` is
   that of holding registers. ``0x1F`` is refused. Sixteen in hexadecimal is ``coil:0x10``.
2. An ``int`` is an offset, also ``40001``: that is item 40002. Only the text ``"40001"`` is the notation.
3. A bare decimal text such as ``"10"`` is refused, because table and base are ambiguous, unless the caller names
   the table; then it is an offset. Text of five or six digits that begins with 0, 1, 3 or 4 stays the notation, and is
   refused where it names another table than the caller's.
4. Where a manual counts otherwise, the caller declares it: ``base=0`` makes ``4x0`` and ``40000`` the first item,
   ``base=1`` makes ``1`` and ``holding:1`` the first item. ``%MW`` and ``%M`` count from 0 always: it is the PLC's
   own number of the memory word.
"""

import re
from dataclasses import dataclass, field
from typing import Final, Literal

from ..codes import TABLE_SIZE, Table
from ..errors import InvalidRequest
from .unfit_values import shown

_PREFIX_OF: Final[dict[Table, str]] = {
    Table.COILS: "0",
    Table.DISCRETE_INPUTS: "1",
    Table.INPUT_REGISTERS: "3",
    Table.HOLDING_REGISTERS: "4",
}
_BY_PREFIX: Final[dict[str, Table]] = {prefix: table for table, prefix in _PREFIX_OF.items()}
_BY_MEMORY: Final[dict[str, Table]] = {"m": Table.COILS, "mw": Table.HOLDING_REGISTERS}
_SHORT_NAME: Final[dict[Table, str]] = {
    Table.COILS: "coil",
    Table.DISCRETE_INPUTS: "discrete",
    Table.INPUT_REGISTERS: "input",
    Table.HOLDING_REGISTERS: "holding",
}
_BY_NAME: Final[dict[str, Table]] = {
    name: table
    for table, short in _SHORT_NAME.items()
    for name in (short, f"{short}s", table.value, table.value.removesuffix("s"))
}

_BIT: Final = r"(?:\.(?P<bit>[0-9]{1,2}))?"
_PREFIXED: Final = re.compile(rf"(?P<table>[0134])[xX](?P<number>[0-9]{{1,6}}){_BIT}")
_DIGITS: Final = re.compile(rf"(?P<table>[0134])(?P<number>[0-9]{{4,5}}){_BIT}")
_NAMED: Final = re.compile(rf"(?P<table>[A-Za-z _-]+):(?P<number>0[xX][0-9a-fA-F]{{1,5}}|[0-9]{{1,6}}){_BIT}")
_MEMORY: Final = re.compile(rf"%(?P<table>[mM][wW]?)(?P<number>[0-9]{{1,6}}){_BIT}")
_BARE: Final = re.compile(rf"(?P<number>[0-9]{{1,6}}){_BIT}")
_LOOKS_HEXADECIMAL: Final = re.compile(r"0[xX]([0-9a-fA-F]{1,16})")


@dataclass(frozen=True, slots=True)
class Address:
    """The address of one register or bit in a table, or of one bit of a register.

    Attributes:
        table: which of the four tables; None if the address names none and the function that takes it decides.
        offset: the item as on the wire, 0…65535.
        bit: a bit of the register, 0 (least significant)…15; None for the whole item.
        text: the text that `parse_address` got without ``base``, for messages; else empty: then ``str`` gives the
            notation of `format_address`, or ``offset 16`` without a table. `parse_address` makes the same address of
            it, or refuses it. Two addresses are equal also if their texts differ.

    Raises:
        InvalidRequest: offset or bit out of range, or a bit of a coil or discrete input. Nothing was sent.
    """

    table: Table | None
    offset: int
    bit: int | None = None
    text: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        written = f"address {shown(self.text)}: " if self.text else ""
        if not isinstance(self.offset, int) or not 0 <= self.offset < TABLE_SIZE:
            raise InvalidRequest(f"{written}offset {shown(self.offset)} is outside 0…{TABLE_SIZE - 1}")
        if self.bit is not None:
            if self.table is not None and self.table.holds_bits:
                raise InvalidRequest(f"{written}a {self.table.label} is one bit and has no bit {self.bit}")
            if not 0 <= self.bit <= 15:
                raise InvalidRequest(f"{written}a register has bits 0…15, not {self.bit}")

    @property
    def number(self) -> int:
        """Number of the item in the data model, 1…65536: its offset plus 1."""
        return self.offset + 1

    def __str__(self) -> str:
        if self.text:
            return self.text
        if self.table is not None:
            return format_address(self)
        return f"offset {self.offset}" if self.bit is None else f"offset {self.offset}.{self.bit}"


def parse_address(
    value: int | str | Address, *, table: Table | None = None, base: Literal[0, 1] | None = None
) -> Address:
    """Parse a data address in any notation, such as ``40001``, ``4x1`` or ``holding:0``, by the rules of this file.

    Args:
        value: an offset, a text in one of the notations, or an `Address`, which is returned with ``table`` if it has no
            table of its own; ``base`` does not change it.
        table: the table that the caller means. None: the notation names it; an ``int`` becomes an address without a
            table then.
        base: number of the first item, 0 or 1, except for ``%MW`` and ``%M``; None for each notation's own base.

    Raises:
        InvalidRequest: not a notation, out of range, ambiguous, of another table than ``table``, or ``base`` is neither
            0 nor 1. Nothing was sent.
    """
    if base not in (None, 0, 1):
        raise InvalidRequest(f"base is {shown(base)}, but items are counted from 0 or from 1")
    if isinstance(value, Address):
        return _in_table(value, table)
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise InvalidRequest(f"an address is an int or text such as '4x1', not {shown(value)}")
    if isinstance(value, str):
        found = _in_table(_from_text(value.strip(), table, base), table)
        if base is None:
            return found
    else:
        found = _address(shown(value), table, value, base or 0, None)
    return Address(found.table, found.offset, found.bit)  # its text would be read as another address


def table_named(name: str) -> Table | None:
    """Return the table that a name means, such as ``holding`` or ``Holding Registers``; None if there is none."""
    return _BY_NAME.get(_plain_name(name))


def format_address(address: Address) -> str:
    """Return an address as prefix and number, 1-based: ``4x17``, ``4x17.3``, ``0x10``; `parse_address` reads it.

    Raises:
        InvalidRequest: the address has no table. Nothing was sent.
    """
    if address.table is None:
        raise InvalidRequest(f"offset {address.offset} has no table, so there is no notation for it")
    bit = "" if address.bit is None else f".{address.bit}"
    return f"{_PREFIX_OF[address.table]}x{address.number}{bit}"


def _from_text(text: str, table: Table | None, base: int | None) -> Address:
    if match := _PREFIXED.fullmatch(text) or _DIGITS.fullmatch(text):
        return _matched(text, match, _BY_PREFIX[match["table"]], 1 if base is None else base)
    if match := _MEMORY.fullmatch(text):
        return _matched(text, match, _BY_MEMORY[match["table"].lower()], 0)
    if match := _NAMED.fullmatch(text):
        name = _plain_name(match["table"])
        if name not in _BY_NAME:
            raise InvalidRequest(
                f"address {shown(text)}: there is no table {name!r}, but {', '.join(_SHORT_NAME.values())}"
            )
        return _matched(text, match, _BY_NAME[name], base or 0)
    if match := _BARE.fullmatch(text):
        if table is None:
            raise _ambiguous(text, int(match["number"]), base)
        return _matched(text, match, table, base or 0)
    if match := _LOOKS_HEXADECIMAL.fullmatch(text):
        raise InvalidRequest(
            f"address {shown(text)} looks hexadecimal, but 0x is the prefix of coils and a decimal number follows;"
            f" hexadecimal needs the table's name: holding:0x{match[1]}, coil:0x{match[1]}"
        )
    begin, colon, rest = text.partition(":")
    if colon and (_PREFIXED.fullmatch(begin) or _DIGITS.fullmatch(begin) or _MEMORY.fullmatch(begin)):
        raise InvalidRequest(f"{shown(text)} is no address, {shown(begin)} is; give {shown(rest)} apart from it")
    raise InvalidRequest(
        f"{shown(text)} is no address; write 4x1 or 40001 (1-based; 0x coil, 1x discrete input, 3x input register,"
        " 4x holding register), holding:0 or holding:0x10 (0-based), or %MW0"
    )


def _plain_name(name: str) -> str:
    return name.strip().lower().replace(" ", "_").replace("-", "_")


def _matched(text: str, match: re.Match[str], table: Table, base: int) -> Address:
    digits = match["number"]
    number = int(digits, 16) if digits[:2].lower() == "0x" else int(digits)
    return _address(text, table, number, base, None if match["bit"] is None else int(match["bit"]))


def _address(text: str, table: Table | None, number: int, base: int, bit: int | None) -> Address:
    if not base <= number < base + TABLE_SIZE:
        item = table.label if table is not None else "item"
        raise InvalidRequest(
            f"address {text}: there is no {item} {shown(number)}; counted from {base}, they are"
            f" {base}…{base + TABLE_SIZE - 1}"
        )
    return Address(table, number - base, bit, text)


def _in_table(address: Address, table: Table | None) -> Address:
    if table is None or address.table is table:
        return address
    if address.table is None:
        return Address(table, address.offset, address.bit, address.text)
    hint = ""
    if (digits := address.text.partition(".")[0]).isdecimal() and int(digits) < TABLE_SIZE:
        hint = f"; for offset {int(digits)} write {_SHORT_NAME[table]}:{int(digits)}"
    elif hexadecimal := _LOOKS_HEXADECIMAL.fullmatch(address.text):
        hint = f"; hexadecimal is written {_SHORT_NAME[table]}:0x{hexadecimal[1]}"
    raise InvalidRequest(
        f"address {address} means {address.table.label} number {address.number}, not one of the {table.label}s{hint}"
    )


def _ambiguous(text: str, number: int, base: int | None) -> InvalidRequest:
    prefixed = number + 1 if base is None else number
    return InvalidRequest(
        f"address {shown(text)} does not say which table nor whether it counts from 0 or 1; write for example"
        f" 4x{prefixed} or holding:{number} for the holding register at offset {number - (base or 0)},"
        f" 3x{prefixed} or input:{number}, 0x{prefixed} or coil:{number}, 1x{prefixed} or discrete:{number}"
    )
