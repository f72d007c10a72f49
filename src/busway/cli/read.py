"""``busway read``: shows values of a device, once or repeatedly.

1. Every address, type and count is checked before the first byte is sent.
2. If one of several addresses cannot be read, the others are read all the same; the exit code is that of the first
   failure. If the connection is lost, the command ends.
3. With ``--watch`` a failure is printed on stderr, and reading goes on.
4. In JSON and CSV a value that could not be read is a record, too, with the reason.
"""

import time
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

import typer

from ..codes import MAX_READ_BITS, MAX_READ_REGISTERS
from ..errors import ConfigError, InvalidRequest, LinkDown, ModbusError
from ..values import Address, ValueType, parse_address, value_type
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
    seconds,
    whole_number,
)
from .exits import ExitCode, exit_code_of
from .files import capturing
from .output import TableRow, Writer, choose_writer, failed_rows, value_rows, warn

if TYPE_CHECKING:
    from ..client.blocking import BlockingUnit

EXAMPLES = """\b
Examples:
  busway read tcp://10.0.0.5 4x1 --count 10
  busway read tcp://10.0.0.5 4x101 --type float32 --order CDAB
  busway read tcp://10.0.0.5:5020 3x1 1x5 holding:0x10 --unit 3 --json
  busway read tcp://10.0.0.5 0x1 -n 16 --watch 1s
  busway read tcp://10.0.0.5 --points meter.toml --unit 7 --json
  busway read tcp://10.0.0.5 --points device:meter voltage_l1 "energy_*" --watch 1s

Addresses: 4x1 or 40001 is the first holding register, 3x1 the first input register,
0x1 the first coil, 1x1 the first discrete input; 4x1.3 is bit 3 of a register;
holding:0 and holding:0x10 count from 0.
"""


@dataclass(frozen=True, slots=True)
class WantedValues:
    """What one argument of ``busway read`` asks for: address, value type, byte order, and number of values."""

    place: Address
    form: ValueType[Any] | None
    """Value type of the registers; None for coils and discrete inputs."""
    order: str
    count: int


def read(
    url: str = URL,
    addresses: list[str] | None = typer.Argument(
        None, metavar="ADDRESS...", help="Where to read: 4x1, 3x17, 0x1, holding:0; with --points, names of points."
    ),
    points: str | None = typer.Option(
        None, "--points", metavar="FILE", help="Read the points of a device file, or of device:NAME, by their names."
    ),
    count: str = typer.Option("1", "-n", "--count", metavar="N", help="Number of values from each address on."),
    unit: str | None = UNIT,
    kind: str | None = TYPE,
    order: str = ORDER,
    watch: str | None = typer.Option(None, "--watch", metavar="TIME", help="Read again and again: every 1s, 500ms."),
    split: bool = typer.Option(False, "--split", help="Take several requests where one does not hold --count values."),
    as_json: bool = JSON,
    as_csv: bool = CSV,
    timeout: str | None = TIMEOUT,
    retries: str | None = RETRIES,
    capture: str | None = CAPTURE,
    verbose: int = VERBOSE,
) -> int:
    """Read values from a device."""
    number = whole_number(count, "--count", 1, 65_536)
    period = None if watch is None else seconds(watch, "--watch", low=0.01)
    if points is not None:
        chosen = {"--count": count != "1", "--type": kind is not None, "--order": order != "ABCD", "--split": split}
        wrong = next((name for name, given in chosen.items() if given), None)
        if wrong is not None:
            raise ConfigError("does not go with --points: the file says it", key=wrong)
        return _read_points(
            url, addresses or [], points, unit, period, as_json, as_csv, timeout, retries, capture, verbose
        )
    if not addresses:
        raise ConfigError("what to read is missing: addresses such as 4x1, or --points FILE", key="ADDRESS...")
    wanted = [_wanted(address, kind, order, number, split=split) for address in addresses]
    with (
        capturing(capture),
        opened_unit(url, unit=unit, timeout=timeout, retries=retries, verbose=verbose) as asked,
    ):
        writer = choose_writer(as_json=as_json, as_csv=as_csv, repeats=period is not None)
        with closing(writer):
            if period is None:
                return _read_once(asked, wanted, writer, split=split)
            with suppress(KeyboardInterrupt):  # this is how watching ends
                _read_again_and_again(asked, wanted, writer, period, split=split)
    return ExitCode.DONE


def _read_points(
    url: str, names: list[str], file: str, unit: str | None, period: float | None, as_json: bool, as_csv: bool,
    timeout: str | None, retries: str | None, capture: str | None, verbose: int,
) -> int:  # fmt: skip
    """Read the points of a device file by their names, print them, and return the exit code."""
    from .read_points import PointReader, load_points, read_points

    number, section = load_points(file, None if unit is None else whole_number(unit, "--unit", 0, 255))
    with (
        capturing(capture),
        opened_unit(
            url, unit=None if number is None else str(number), timeout=timeout, retries=retries, verbose=verbose
        ) as asked,
    ):
        reader = PointReader(asked, section, names)
        return read_points(reader, unit=number, as_json=as_json, as_csv=as_csv, period=period)


def _wanted(text: str, kind: str | None, order: str, count: int, *, split: bool) -> WantedValues:
    """Return what one argument of ``busway read`` asks for.

    Args:
        text: the argument, an address.
        kind: text of ``--type``; None for ``uint16``, or one bit where the address is one.
        order: text of ``--order``.
        count: number of values.
        split: whether several requests are allowed.

    Raises:
        ConfigError, InvalidRequest: the address, type or order is invalid, or there are too many values for one request
            and ``split`` is False.
    """
    if text.startswith("-"):
        raise ConfigError("there is no such option", key=text)
    place = parse_address(text)
    assert place.table is not None  # a text that names no table is refused
    form = None
    limit, items = MAX_READ_BITS, count
    if place.table.holds_bits:
        if kind is not None:
            raise InvalidRequest(f"{place}: a {place.table.label} is one bit and has no type {kind}")
    else:
        if place.bit is not None and kind is not None:
            raise InvalidRequest(f"{place}: one bit of a register has no type {kind}")
        form = value_type(kind or "uint16" if place.bit is None else f"bit:{place.bit}", order)
        limit, items = MAX_READ_REGISTERS, form.registers_for(count)
    check_order(place, form, order)
    if items > limit and not split:
        raise InvalidRequest(
            f"{place}: {count} values are {items} {place.table.label}s, and one request reads at most {limit};"
            f" --count {limit // (form.registers if form else 1)} at most, or --split"
        )
    return WantedValues(place, form, order, count)


def _read_once(unit: "BlockingUnit", wanted: Sequence[WantedValues], writer: Writer, *, split: bool) -> int:
    rows: list[TableRow] = []
    code: int = ExitCode.DONE
    for number, each in enumerate(wanted):
        try:
            rows += _rows(unit, each, split=split)
        except InvalidRequest:
            raise
        except ModbusError as error:
            if isinstance(error, LinkDown) or len(wanted) == 1:
                writer.write([*rows, *(row for one in wanted[number:] for row in _failed(one, error))])
                raise
            warn(f"{each.place}: {error}")
            rows += _failed(each, error)
            code = code or exit_code_of(error)
    writer.write(rows)
    return code


def _failed(wanted: WantedValues, error: ModbusError) -> list[TableRow]:
    """Return the rows to print for values that could not be read because of ``error``."""
    from ..points.quality import reason_text
    from .read_points import reason_of

    return failed_rows(wanted.place, wanted.form, wanted.count, reason_text(reason_of(error)))


def _read_again_and_again(
    unit: "BlockingUnit", wanted: Sequence[WantedValues], writer: Writer, period: float, *, split: bool
) -> None:
    due = time.monotonic()
    while True:
        now = datetime.now().astimezone().isoformat(timespec="milliseconds")
        rows: list[TableRow] = []
        for each in wanted:
            try:
                rows += _rows(unit, each, split=split)
            except InvalidRequest:
                raise
            except ModbusError as error:
                warn(f"{now} {each.place}: {error}")
                rows += _failed(each, error)
        writer.write(rows, now)
        due = max(due + period, time.monotonic())
        time.sleep(due - time.monotonic() if due > time.monotonic() else 0)


def _rows(unit: "BlockingUnit", wanted: WantedValues, *, split: bool) -> list[TableRow]:
    """Read the values that one argument asks for, and return them as rows to print, with their bytes."""
    from ..client.operations import read_values

    form = None if wanted.place.bit is not None else wanted.form  # the bit of an address is its type
    operation = read_values(wanted.place, form, wanted.order, wanted.count, split)
    raw = b""
    requests = next(operation)
    while True:
        replies = unit.execute_many(requests)
        for request, reply in zip(requests, replies, strict=True):
            raw += reply.data if wanted.form is not None else bytes(reply.bits(request.values()["count"]))
        try:
            requests = operation.send(replies)
        except StopIteration as stop:
            return value_rows(wanted.place, wanted.form, stop.value, raw)
