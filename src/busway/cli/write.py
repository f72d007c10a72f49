"""``busway write``: writes values to consecutive addresses of a device, in one request.

1. All values are checked before the first byte is sent; one that does not fit is refused, never truncated.
2. An argument that begins with a minus sign is a value (``-5``), unless it is an option.
3. A write is never repeated: without an answer its outcome is unknown, and the exit code 3.
4. The output says that a value was written. What the device holds is known only if ``--verify`` has read it back.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import typer

from ..codes import Table
from ..errors import ConfigError, InvalidRequest, ModbusError
from ..options.endpoints import parse_endpoint
from ..pdu.write_items import pack_registers
from ..values import Address, ValueType, format_address, parse_address, parse_bit, value_type
from .arguments import (
    CAPTURE,
    CSV,
    JSON,
    ORDER,
    RETRIES,
    TIMEOUT,
    TYPE,
    UNIT,
    URL,
    VERBOSE,
    check_order,
    opened_unit,
    refuse_unknown_option,
    whole_number,
)
from .exits import ExitCode
from .files import capturing
from .output import NOT_READ_BACK, TableRow, choose_writer, print_csv, print_json, shown_value, value_rows, warn

if TYPE_CHECKING:
    from ..client.blocking import BlockingUnit
    from ..client.operations import WriteFunctionChoice

EXAMPLES = """\b
Examples:
  busway write tcp://10.0.0.5 4x10 42 43
  busway write tcp://10.0.0.5 4x101 -3.5 --type float32 --order CDAB
  busway write tcp://10.0.0.5 0x1 on off on
  busway write tcp://10.0.0.5 4x7.3 on
  busway write tcp://10.0.0.5 4x7 --mask 0xFF0F 0x0050
  busway write tcp://10.0.0.5 4x10 42 --verify

--mask AND OR sets a register to (register AND and) OR (or AND NOT and), function 22.
--verify reads back, and ends with 7 where the device holds something else.
A text value that begins with a minus sign is written behind --.
"""

SETTINGS = {"ignore_unknown_options": True}

_Found = TypeVar("_Found")
_FUNCTIONS: tuple["WriteFunctionChoice", ...] = ("auto", "single", "multiple")


def write(
    url: str = URL,
    address: str = typer.Argument(..., metavar="ADDRESS", help="Where to write: 4x1, 0x1, holding:0, 4x1.3."),
    texts: list[str] | None = typer.Argument(None, metavar="VALUE...", help="Numbers, texts, or on and off."),
    unit: str | None = UNIT,
    kind: str | None = TYPE,
    order: str = ORDER,
    mask: tuple[str, str] | None = typer.Option(
        None, "--mask", metavar="AND OR", help="Change bits of one register, function 22; no VALUE then."
    ),
    function: str = typer.Option(
        "auto", "--function", metavar="WHICH", help="single (05, 06), multiple (15, 16), or auto."
    ),
    verify: bool = typer.Option(
        False, "--verify", help="Read back what was written; exit code 7 where the device holds something else."
    ),
    as_json: bool = JSON,
    as_csv: bool = CSV,
    timeout: str | None = TIMEOUT,
    retries: str | None = RETRIES,
    capture: str | None = CAPTURE,
    verbose: int = VERBOSE,
) -> int:
    """Write values to a device."""
    for text in (url, address, *(texts or ())):
        refuse_unknown_option(text)
    chosen = next((each for each in _FUNCTIONS if each == function), None)
    if chosen is None:
        raise ConfigError(f"one of {', '.join(_FUNCTIONS)} is needed, not {function!r}", key="--function")
    place = parse_address(address)
    if chosen != "auto" and (mask is not None or place.bit is not None):
        what = "--mask" if mask is not None else f"{place}, one bit of a register"
        raise ConfigError(f"has no effect on {what}, which is written by function 22", key="--function")
    if (
        verify
        and unit is not None
        and parse_endpoint(url).framing != "mbap"
        and whole_number(unit, "--unit", 0, 255) == 0
    ):
        raise ConfigError(
            "does not go with unit 0: a broadcast is not answered, so nothing can be read back", key="--verify"
        )
    writer = choose_writer(as_json=as_json, as_csv=as_csv)
    reach: dict[str, Any] = {"unit": unit, "timeout": timeout, "retries": retries, "verbose": verbose}
    if mask is not None:
        masks = _masks(place, mask, texts)
        with capturing(capture), opened_unit(url, **reach) as asked:
            return _write_mask(asked, place, *masks, verify=verify, as_json=as_json, as_csv=as_csv)
    if not texts:
        raise ConfigError(f"there is no value to write to {place}", key="VALUE")
    form, values, raw = _parsed(place, texts, kind, order)
    held_values = values if form is None else form.decode(raw)  # rounded to the type, as 0.1 is in a float32
    with capturing(capture), opened_unit(url, **reach) as asked:
        asked.write(place, values[0] if place.bit is not None else values, form, function=chosen)
        rows = [replace(row, written=True) for row in value_rows(place, form, held_values, raw)]
        held = _read_back(lambda: _held(asked, place, form, raw)) if verify else None
    if held is not None:
        rows = _compared(rows, value_rows(place, form, *held))
    elif verify:
        rows = [replace(row, verified=False, read_back=False) for row in rows]
    writer.write(rows)
    return ExitCode.NOT_VERIFIED if verify and not all(row.verified for row in rows) else ExitCode.DONE


def _read_back(read: Callable[[], _Found]) -> _Found | None:
    """Return the result of ``read``, which reads written values back; on a `ModbusError` warn and return None."""
    try:
        return read()
    except ModbusError as error:
        warn(f"it was written, but could not be read back: {error}")
        return None


def _held(unit: "BlockingUnit", place: Address, form: ValueType[Any] | None, raw: bytes) -> tuple[Sequence[Any], bytes]:
    """Read the values that the device now has at the addresses that were written; return them and their bytes.

    Args:
        unit: the unit to ask.
        place: the first address.
        form: the value type; None for bits.
        raw: the bytes that were written; only their number counts.
    """
    if form is None:
        found = unit.read(place, count=None if place.bit is not None else len(raw))
        states = found if isinstance(found, list) else [found]
        return states, bytes(states)
    data = pack_registers(unit.read_holding_registers(place.offset, count=len(raw) // 2))
    return form.decode(data), data


def _compared(written: Sequence[TableRow], held: Sequence[TableRow]) -> list[TableRow]:
    """Return the rows of written values with what reading back showed; warn about values the device does not hold.

    ``held`` are the rows that were read back, one for each of ``written``.
    """
    compared = []
    for row, found in zip(written, held, strict=True):
        is_there = row.raw == found.raw
        compared.append(replace(row, verified=is_there, holds=None if is_there else found.value))
        if not is_there:
            warn(
                f"{row.address}: written, but the device holds {shown_value(found.value)}, not {shown_value(row.value)}"
            )
    return compared


def _masks(place: Address, mask: tuple[str, str], texts: list[str] | None) -> tuple[int, int]:
    """Return the AND mask and the OR mask that ``--mask`` gives.

    Args:
        place: the address; it must be a holding register.
        mask: the texts of both masks, 0…0xFFFF.
        texts: the values on the command line; with a mask there must be none.

    Raises:
        ConfigError: one of these conditions is not met.
    """
    if texts:
        raise ConfigError(f"takes the place of values, but there is {texts[0]!r}", key="--mask")
    if place.table is not Table.HOLDING_REGISTERS or place.bit is not None:
        raise ConfigError(f"goes with a holding register, not with {place}", key="--mask")
    and_mask, or_mask = (whole_number(text, "--mask", 0, 0xFFFF) for text in mask)
    return and_mask, or_mask


def _write_mask(
    unit: "BlockingUnit", place: Address, and_mask: int, or_mask: int, *, verify: bool, as_json: bool, as_csv: bool
) -> int:
    unit.mask_write_register(place.offset, and_mask=and_mask, or_mask=or_mask)
    code, outcome = ExitCode.DONE, "written"
    told: dict[str, Any] = {}  # what `holds` and `verified` are
    if verify:
        code, outcome, told["verified"] = ExitCode.NOT_VERIFIED, NOT_READ_BACK, False
        found = _read_back(lambda: unit.read_holding_registers(place.offset, count=1)[0])
        if found is not None:
            told["verified"] = not (found ^ or_mask) & ~and_mask & 0xFFFF  # the bits that AND does not keep
            outcome = "written, read back" if told["verified"] else f"written, but the device holds 0x{found:04X}"
            code = ExitCode.DONE if told["verified"] else code
            if not told["verified"]:
                told["holds"] = found
                warn(f"{place}: {outcome}")
    where = format_address(place)
    if as_json:
        at = {"address": where, "table": Table.HOLDING_REGISTERS.value, "offset": place.offset}
        print_json({**at, "and_mask": and_mask, "or_mask": or_mask, "written": True, **told})
    elif as_csv:
        print_csv(
            ["address", "and_mask", "or_mask", "outcome"], [[where, f"{and_mask:04x}", f"{or_mask:04x}", outcome]]
        )
    else:
        print(f"{where}  AND 0x{and_mask:04X} OR 0x{or_mask:04X}  {outcome}", flush=True)
    return code


def _parsed(
    place: Address, texts: list[str], kind: str | None, order: str
) -> tuple[ValueType[Any] | None, list[Any], bytes]:  # Any: what the type says
    """Return the value type (None for bits), the values that the arguments give, and their bytes in wire order.

    Args:
        place: the first address.
        texts: the values as texts.
        kind: text of ``--type``; None for ``uint16`` or bits, by the table.
        order: text of ``--order``.

    Raises:
        InvalidRequest: the table is read-only, or a value does not fit its type.
        ConfigError: the order has no effect on these values.
    """
    if place.table is None or not place.table.is_writable:
        raise InvalidRequest(f"{place}: {place.table.label if place.table else 'table'}s are read-only")
    if place.table.holds_bits or place.bit is not None:
        if kind is not None:
            raise InvalidRequest(f"{place} is one bit and has no type {kind}")
        if place.bit is not None and len(texts) > 1:
            raise InvalidRequest(f"{place} is one bit, but there are {len(texts)} values")
        check_order(place, None, order)
        states = [parse_bit(text) for text in texts]
        return None, states, bytes(states)
    form = value_type(kind or "uint16", order)
    check_order(place, form, order)
    try:
        values = [form.parse(text) for text in texts]
        return form, values, form.encode(values)
    except InvalidRequest as error:
        if form.name.startswith("uint") and any(text.startswith("-") for text in texts):
            signed = form.name.removeprefix("u")
            raise InvalidRequest(f"{error}; a negative number needs a signed type: --type {signed}") from error
        raise
