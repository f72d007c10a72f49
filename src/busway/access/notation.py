"""Parsers of the units, functions and address ranges that people write in access rules.

Knows texts and numbers; knows no rule.

==============  ======================================================================================
units           ``"1-5, 7"``, ``7``, ``["1-5", 7]``: 0…255
functions       ``"read_holding_registers"``, ``16``, ``"0x10"``, ``"8/1"`` (sub-function), ``"43/14"``;
                the groups ``"read"``, ``"write"``, ``"diagnostics"``
items           ``"4x101-4x200"``, ``"40101-40200"``, ``"holding:100-199"``, ``"%MW100-%MW199"``;
                with a table also ``"100-199"`` and ``100`` (offsets, 0-based)
files           ``"1-4"``: numbers of files, 0…65535
==============  ======================================================================================

A range includes both its ends.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Final

from ..codes import TABLE_SIZE, DiagnosticCode, FunctionCode, MeiType, Table
from ..errors import ConfigError, InvalidRequest
from ..values import Address, parse_address
from ..values.addresses import table_named
from ..values.unfit_values import shown

NumberRange = tuple[int, int]
"""A range of numbers: the first number, and the number after the last."""
Function = tuple[int, int | None]
"""A function code, and a sub-function or None for all of them."""

_RANGE_SIGN: Final = re.compile(r" ?(?:\.\.|…|-) ?")
_LONGEST_PART: Final = 100
"""Most characters of one number or range, several blanks counted once; the longest valid one has 50."""
_NUMBER: Final = re.compile(r"[0-9]{1,6}|0[xX][0-9a-fA-F]{1,5}")

FUNCTION_GROUPS: Final[Mapping[str, frozenset[int]]] = {
    "read": frozenset({1, 2, 3, 4, 20, 24}),
    "write": frozenset({5, 6, 15, 16, 21, 22, 23}),
    "diagnostics": frozenset({7, 8, 11, 12, 17}),
}
"""Function codes by group name. 23, which also reads, is in the group of writes; 43 is in no group."""
_SHORT_NAMES: Final[Mapping[str, FunctionCode]] = {
    "write_coil": FunctionCode.WRITE_SINGLE_COIL,
    "write_register": FunctionCode.WRITE_SINGLE_REGISTER,
    "write_coils": FunctionCode.WRITE_MULTIPLE_COILS,
    "write_registers": FunctionCode.WRITE_MULTIPLE_REGISTERS,
    "read_write_registers": FunctionCode.READ_WRITE_MULTIPLE_REGISTERS,
}
_CODE_OF: Final[Mapping[str, int]] = {**{each.name.lower(): each.value for each in FunctionCode}, **_SHORT_NAMES}
_SUB_NAMES: Final[Mapping[str, Function]] = {
    **{each.name.lower(): (FunctionCode.DIAGNOSTICS.value, each.value) for each in DiagnosticCode},
    **{each.name.lower(): (FunctionCode.ENCAPSULATED_INTERFACE.value, each.value) for each in MeiType},
}


def parse_units(value: str | int | Iterable[str | int]) -> frozenset[int]:
    """Parse unit numbers such as ``1-10, 17`` into the set of units. An empty list gives an empty set.

    Raises:
        ConfigError: a part of the text is no number or range, is above 255, or ends before it begins.
    """
    return frozenset(unit for first, end in _ranges(value, 255, "unit") for unit in range(first, end))


def parse_files(value: str | int | Iterable[str | int]) -> tuple[NumberRange, ...]:
    """Parse file numbers such as ``1-4`` into ascending ranges, joined where they touch: ``((1, 5),)``.

    Raises:
        ConfigError: a part of the text is no number or range, is above 65535, or ends before it begins.
    """
    return merged(_ranges(value, 0xFFFF, "file"))


def parse_functions(value: str | int | Iterable[str | int]) -> frozenset[Function]:
    """Parse function codes, names and groups, such as ``3, write single coil, diagnostics, 8/1``, into a set of pairs.

    Each pair is a function code and a sub-function, which is None for the whole function with all its sub-functions.
    Capitals do not matter.

    Raises:
        ConfigError: a name is unknown, a code is not 1…127, or a code other than 8 and 43 has a sub-function.
    """
    found: set[Function] = set()
    for each in [value] if isinstance(value, str | int) else value:
        for part in each.split(",") if isinstance(each, str) else [each]:
            found |= _functions(part.strip().lower().replace(" ", "_") if isinstance(part, str) else part)
    return frozenset(found)


def parse_whole_functions(value: str | int | Iterable[str | int], what: str) -> frozenset[int]:
    """Parse function codes, names and groups into a set of function codes. Sub-functions such as ``8/1`` are refused.

    Args:
        value: the notation, as for `parse_functions`.
        what: whose functions they are, for the error about a sub-function: ``a route``.

    Raises:
        ConfigError: the notation is invalid, or names a sub-function.
    """
    found = parse_functions(value)
    for code, sub_code in found:
        if sub_code is not None:
            raise ConfigError(f"{what} is for whole functions, not for sub-function {code}/{sub_code}")
    return frozenset(code for code, _ in found)


def parse_table(value: str | Table) -> Table:
    """Parse the name of a table: ``holding``, ``holding_registers``, ``coil``. A `Table` is returned unchanged.

    Raises:
        ConfigError: there is no table with this name.
    """
    if isinstance(value, Table):
        return value
    found = table_named(str(value))
    if found is None:
        raise ConfigError(f"there is no table {shown(value)}, but coil, discrete, input, holding")
    return found


def parse_items(value: str | int | Iterable[str | int], table: Table | None) -> dict[Table, tuple[NumberRange, ...]]:
    """Parse item ranges such as ``holding:100-199`` into ascending ranges by table, joined where they touch.

    Args:
        value: the notation.
        table: the table of offsets that name none, such as ``100-199``; a range that names another table is refused.
            None: every range must name its table.

    Raises:
        ConfigError: a range is invalid, names no table or another than ``table``, or is for a bit of a register.
    """
    found: dict[Table, list[NumberRange]] = {}
    for each in [value] if isinstance(value, str | int) else value:
        for part in each.split(",") if isinstance(each, str) else [each]:
            where, items = _item_range(part, table)
            found.setdefault(where, []).append(items)
    return {where: merged(ranges) for where, ranges in found.items()}


def merged(ranges: Iterable[NumberRange]) -> tuple[NumberRange, ...]:
    """Return ranges in ascending order, with those that overlap or touch joined to one."""
    found: list[NumberRange] = []
    for first, end in sorted(ranges):
        if found and first <= found[-1][1]:
            found[-1] = (found[-1][0], max(found[-1][1], end))
        else:
            found.append((first, end))
    return tuple(found)


def _ranges(value: str | int | Iterable[str | int], highest: int, what: str) -> list[NumberRange]:
    """Parse numbers and ranges such as ``1-10, 17`` into ranges, in the order in which they are written.

    Args:
        value: the notation.
        highest: the highest number that is allowed; the lowest is 0.
        what: what the numbers are, for errors: ``unit``.

    Raises:
        ConfigError: a part of the text is no number or range, is above ``highest``, or ends before it begins.
    """

    def number(text: str) -> int:
        if not _NUMBER.fullmatch(text):
            raise ConfigError(f"{shown(text)} is no {what}, nor a range such as 1-5")
        found = _number(text)
        if found > highest:
            raise ConfigError(f"a {what} is 0…{highest}, not {found}")
        return found

    found: list[NumberRange] = []
    for each in [value] if isinstance(value, str | int) else value:
        if isinstance(each, bool) or not isinstance(each, str | int):
            raise ConfigError(f"{shown(each)} is no {what}, nor a range such as '1-5'")
        for part in str(each).split(","):
            first, last = _ends(part, number)
            found.append((first, last + 1))
    return found


def _number(text: str) -> int:
    """Return the number for a text that `_NUMBER` matches; it is decimal also with zeros at its begin."""
    return int(text, 16 if text[:2] in ("0x", "0X") else 10)


def _ends(part: str, number: Callable[[str], int]) -> NumberRange:
    texts = _RANGE_SIGN.split(_with_single_blanks(part))
    if len(texts) > 2:
        raise ConfigError(f"{shown(part)} is no range such as 1-5")
    first, last = number(texts[0]), number(texts[-1])
    if last < first:
        raise ConfigError(f"{shown(part)} ends before it begins")
    return first, last


def _with_single_blanks(part: str) -> str:
    """Return one number or range of a rule's text without blanks around it, and with single blanks inside.

    Raises `ConfigError` if it has more than 100 characters then: later steps take time with the square of the length.
    """
    text = " ".join(part.split())
    if len(text) > _LONGEST_PART:
        raise ConfigError(f"{shown(text)} is longer than {_LONGEST_PART} characters; put a comma between ranges")
    return text


def _functions(text: str | int) -> set[Function]:
    if isinstance(text, bool) or not isinstance(text, str | int):
        raise ConfigError(f"{shown(text)} is no function")
    if isinstance(text, str):
        if text in FUNCTION_GROUPS:
            return {(code, None) for code in FUNCTION_GROUPS[text]}
        if text in _CODE_OF:
            return {(_CODE_OF[text], None)}
        if text in _SUB_NAMES:
            return {_SUB_NAMES[text]}
        code_text, slash, sub_text = text.partition("/")
        if not _NUMBER.fullmatch(code_text) or (slash and not _NUMBER.fullmatch(sub_text)):
            known = ", ".join([*FUNCTION_GROUPS, *_CODE_OF])
            raise ConfigError(f"there is no function {shown(text)}; write a code, code/sub-function or one of {known}")
        code, sub_code = _number(code_text), _number(sub_text) if slash else None
    else:
        code, sub_code = text, None
    if not 1 <= code <= 127:
        raise ConfigError(f"a function code is 1…127, not {code}")
    if sub_code is not None and code not in (FunctionCode.DIAGNOSTICS, FunctionCode.ENCAPSULATED_INTERFACE):
        raise ConfigError(f"only functions 8 and 43 have sub-functions, not {code}")
    return {(code, sub_code)}


def _item_range(part: str | int, table: Table | None) -> tuple[Table, NumberRange]:
    """Parse one item or item range such as ``holding:100-199`` into its table and its range of offsets.

    Args:
        part: the item or range.
        table: its table if it names none; None: it must name its table.

    Raises:
        ConfigError: the range is invalid, names no table or another than ``table``, or is for a bit of a register.
    """
    if isinstance(part, str):
        text = _with_single_blanks(part)
        # A minus sign may belong to a table's name (holding-registers:5): the last one may be the sign of a range.
        match = re.fullmatch(r"(.+?) ?(?:\.\.|…|-) ?([^-…]+)", text)
        if match is not None and (match[2][0].isdigit() or match[2][0] == "%"):
            first = _item(match[1], table)
            last = _item(_with_notation_of(match[1], match[2]), table)
            if last.table is not first.table or last.offset < first.offset:
                raise ConfigError(f"{shown(part)} does not end in the table where it begins, or ends before it begins")
            assert first.table is not None  # `_item` has seen to it
            return first.table, (first.offset, last.offset + 1)
        part = text
    found = _item(part, table)
    assert found.table is not None  # `_item` has seen to it
    return found.table, (found.offset, found.offset + 1)


def _with_notation_of(first: str, last: str) -> str:
    """Return the end of an item range with the prefix of its start: ``199`` after ``holding:100`` is ``holding:199``.

    An end that has a prefix of its own is returned unchanged, and so is the end if the start has none.
    """
    prefix = re.match(r"[0134][xX]|[A-Za-z _-]+:|%[mM][wW]?", first.strip())
    if prefix is None or not (last.isdecimal() or (prefix[0].endswith(":") and _NUMBER.fullmatch(last))):
        return last
    return f"{prefix[0]}{last}"


def _item(text: str | int, table: Table | None) -> Address:
    try:
        found = parse_address(text, table=table)
    except InvalidRequest as error:
        raise ConfigError(str(error)) from error
    if found.table is None:
        raise ConfigError(f"{shown(text)} does not say which table it is of, and no table is named beside it")
    if found.bit is not None:
        raise ConfigError(f"{shown(text)}: rules are for whole registers, not for a bit of one")
    assert 0 <= found.offset < TABLE_SIZE
    return found
