"""``busway write``: values to consecutive places of a device, in one request.

1. All values are checked before the first byte goes out; one that does not fit is refused, never truncated.
2. What begins with a minus sign is a value here (``-5``), unless it is an option.
3. A write is never repeated: without an answer its outcome is unknown, exit code 3.
"""

from typing import TYPE_CHECKING, Any

import typer

from ..codes import Table
from ..errors import ConfigError, InvalidRequest
from ..values import Address, ValueType, parse_address, parse_bit, value_type
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
    opened_unit,
    refuse_unknown_option,
    whole_number,
)
from .exits import ExitCode
from .files import capturing
from .output import choose_writer, value_rows

if TYPE_CHECKING:
    from ..client.operations import WriteFunction

EXAMPLES = """\b
Examples:
  busway write tcp://10.0.0.5 4x10 42 43
  busway write tcp://10.0.0.5 4x101 -3.5 --type float32 --order CDAB
  busway write tcp://10.0.0.5 0x1 on off on
  busway write tcp://10.0.0.5 4x7.3 on
  busway write tcp://10.0.0.5 4x7 --mask 0xFF0F 0x0050

--mask AND OR sets a register to (register AND and) OR (or AND NOT and), function 22.
A text value that begins with a minus sign is written behind --.
"""

SETTINGS = {"ignore_unknown_options": True}

_FUNCTIONS: tuple["WriteFunction", ...] = ("auto", "single", "multiple")


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
    if mask is not None:
        with capturing(capture):
            return _write_mask(place, mask, texts, url, unit=unit, timeout=timeout, retries=retries, verbose=verbose)
    if not texts:
        raise ConfigError(f"there is no value to write to {place}", key="VALUE")
    form, values, raw = _parsed(place, texts, kind, order)
    writer = choose_writer(as_json=as_json, as_csv=as_csv)
    with (
        capturing(capture),
        opened_unit(url, unit=unit, timeout=timeout, retries=retries, verbose=verbose) as asked,
    ):
        asked.write(place, values[0] if place.bit is not None else values, form, function=chosen)
    writer.write(value_rows(place, form, values, raw))
    return ExitCode.DONE


def _write_mask(
    place: Address, mask: tuple[str, str], texts: list[str] | None, url: str, **reach: Any
) -> int:  # Any: the options of `opened_unit`
    if texts:
        raise ConfigError(f"takes the place of values, but there is {texts[0]!r}", key="--mask")
    if place.table is not Table.HOLDING_REGISTERS or place.bit is not None:
        raise ConfigError(f"goes with a holding register, not with {place}", key="--mask")
    and_mask, or_mask = (whole_number(text, "--mask", 0, 0xFFFF) for text in mask)
    with opened_unit(url, **reach) as asked:
        asked.mask_write_register(place.offset, and_mask=and_mask, or_mask=or_mask)
    return ExitCode.DONE


def _parsed(
    place: Address, texts: list[str], kind: str | None, order: str
) -> tuple[ValueType | None, list[Any], bytes]:  # Any: what the type says
    """Type (None for bits), values and their bytes."""
    if place.table is None or not place.table.is_writable:
        raise InvalidRequest(f"{place}: a {place.table.label if place.table else 'table'} can not be written")
    if place.table.holds_bits or place.bit is not None:
        if kind is not None:
            raise InvalidRequest(f"{place} is one bit and has no type {kind}")
        if place.bit is not None and len(texts) > 1:
            raise InvalidRequest(f"{place} is one bit, but there are {len(texts)} values")
        states = [parse_bit(text) for text in texts]
        return None, states, bytes(states)
    form = value_type(kind or "uint16", order)
    try:
        values = [form.parse(text) for text in texts]
        return form, values, form.encode(values)
    except InvalidRequest as error:
        if form.name.startswith("uint") and any(text.startswith("-") for text in texts):
            signed = form.name.removeprefix("u")
            raise InvalidRequest(f"{error}; a negative number needs a signed type: --type {signed}") from error
        raise
