"""Options that several commands share, and the conversion of their texts to checked values.

Knows how arguments are written and how errors name them; sends nothing.
"""

import contextlib
import re
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, Final

import typer

from ..errors import ConfigError
from ..values.durations import duration

if TYPE_CHECKING:
    from ..client.blocking import BlockingUnit
    from ..values import Address, ValueType

URL = typer.Argument(..., metavar="URL", help="The device: tcp://10.0.0.5, tcp://host:5020.")
UNIT = typer.Option(None, "-u", "--unit", metavar="U", help="Unit identifier, 0…255. On TCP 255, the device itself.")
UNIT_OF_FILE = typer.Option(
    None, "-u", "--unit", metavar="U", help="The unit of a FILE that does not say it, 0…255; without FILE, 1."
)
TYPE = typer.Option(
    None,
    "-t",
    "--type",
    metavar="TYPE",
    help="int16…int64, uint16…uint64, float16…float64, bcd16…bcd64, string:N, bits.",
)
ORDER = typer.Option("ABCD", "--order", metavar="ORDER", help="Order of bytes and registers: ABCD, CDAB, BADC, DCBA…")
TIMEOUT = typer.Option(None, "--timeout", metavar="TIME", help="Wait this long for each reply: 3s; on a line 1s.")
RETRIES = typer.Option(None, "--retries", metavar="N", help="Further attempts of a read: 1. A write is never repeated.")
VERBOSE = typer.Option(
    0, "-v", "--verbose", count=True, help="Show messages on stderr; -vv frames too, -vvv every byte."
)


def _show_progress(quiet: bool) -> None:
    from .output import show_progress

    show_progress(not quiet)


QUIET = typer.Option(False, "-q", "--quiet", help="Print results and what fails, no progress.", callback=_show_progress)
CAPTURE = typer.Option(
    None, "--capture", metavar="FILE", help="Write all traffic to a capture file for Wireshark: line.pcapng."
)
JSON = typer.Option(False, "--json", help="Print one JSON object per line.")
CSV = typer.Option(False, "--csv", help="Print CSV with a header line.")

_NUMBER = re.compile(r"\d{1,18}|0[xX][0-9a-fA-F]{1,16}")


def unit_number(text: str | None) -> int | None:
    """Return the text of ``--unit`` as a number; None if the option is missing. `ConfigError` unless it is 0…255."""
    return None if text is None else whole_number(text, "--unit", 0, 255)


@contextlib.contextmanager
def hint_at_unit() -> Iterator[None]:
    """Context manager that makes an error about a missing unit number mention the option ``--unit``.

    It concerns the `FileError` about a file whose only unit has no number; other errors pass unchanged.
    """
    from ..config.files.file_error import FileError

    try:
        yield
    except FileError as error:
        raise FileError(
            [
                ConfigError(f"{each.message}; or say it by --unit", file=each.file, line=each.line, key=each.key)
                if each.key == "unit[0].unit" and each.message == "is missing"
                else each
                for each in error.problems
            ]
        ) from None


def refuse_other_unit(name: str, unit: int | None, there: Iterable[int]) -> None:
    """Raise `ConfigError` if ``--unit`` names a unit that a file does not have.

    Args:
        name: name of the file, for the error.
        unit: number given by ``--unit``; None if the option is missing.
        there: numbers of the units in the file.

    Raises:
        ConfigError: ``unit`` is given and not in ``there``; the message lists the numbers in the file.
    """
    numbers = list(there)
    if unit is not None and unit not in numbers:
        units = f"unit {numbers[0]}" if len(numbers) == 1 else f"units {', '.join(map(str, numbers))}"
        raise ConfigError(f"{name} has the {units}, not {unit}", key="--unit")


def whole_number(text: str, name: str, low: int, high: int) -> int:
    """Return the whole number that an option's text gives, in decimal or as ``0x…``.

    Args:
        text: the text of the option; a sign is not allowed.
        name: name of the option, for the error: ``--count``.
        low, high: smallest and largest number allowed.

    Raises:
        ConfigError: the text is not a whole number, or the number is out of range.
    """
    number = int(text, 16 if text[:2].lower() == "0x" else 10) if _NUMBER.fullmatch(text) else -1
    if not low <= number <= high:
        raise ConfigError(f"a whole number {low}…{high} is needed, not {text!r}", key=name)
    return number


def seconds(text: str, name: str, *, low: float = 0.001, high: float = 86_400) -> float:
    """Return the time that an option's text gives, in seconds: ``500ms``, ``1s``, ``2`` (seconds), ``1h``.

    Args:
        text: the text of the option.
        name: name of the option, for the error: ``--timeout``.
        low, high: shortest and longest time allowed, in seconds.

    Raises:
        ConfigError: the text is not a time, or the time is out of range.
    """
    time = duration(text, bare=True)
    if time is None:
        raise ConfigError(f"a time such as 500ms, 1s or 2m is needed, not {text!r}", key=name)
    if not low <= time <= high:
        raise ConfigError(f"a time of {low:g}…{high:g} s is needed, not {text!r}", key=name)
    return time


def limits_of(kind: type[Any], option: str) -> tuple[float, float]:
    """Return the smallest and the largest value that an option accepts, in the unit of the option (times: seconds).

    Args:
        kind: the class of `busway.options` that declares the option.
        option: name of the option, whose limits must be a `Range`: ``timeout``.
    """
    from ..options.declaration import Range, declared

    limits = declared(kind)[option].limits
    assert isinstance(limits, Range)
    return limits.low, limits.high


BEHIND_DASHES: Final[list[str]] = []
"""The arguments of the command line behind ``--``, which are never options; the command's parser fills the list."""


def refuse_unknown_option(value: str) -> None:
    """Raise `ConfigError` if a value looks like a misspelt option: one or two minus signs followed by a letter.

    Values such as ``-5``, ``-inf`` and ``-nan`` are accepted, and so are the arguments behind ``--``. For commands
    whose parser takes unknown options as values.
    """
    if value in BEHIND_DASHES:
        return
    if re.match(r"--?[a-zA-Z]", value) and value.lower() not in ("-inf", "-infinity", "-nan"):
        raise ConfigError(f"there is no such option; a text that begins so is written behind --: -- {value}", key=value)


@contextlib.contextmanager
def opened_unit(
    url: str, *, unit: str | None, timeout: str | None, retries: str | None, verbose: int
) -> Iterator["BlockingUnit"]:
    """Context manager that opens a blocking link to a URL, yields one of its units, and closes the link at the end.

    Nothing is sent by that.

    Args:
        url: URL of the device.
        unit, timeout, retries: texts of ``--unit``, ``--timeout`` and ``--retries``; None for the default of the link.
        verbose: how often ``-v`` was given, as of `show_traffic`.

    Raises:
        ConfigError, InvalidRequest: the URL or an option is invalid.
    """
    from ..client.blocking import connect
    from ..options.client import ClientParameters

    options: dict[str, Any] = {}  # fields of different types
    if timeout is not None:
        low, high = limits_of(ClientParameters, "timeout")
        options["timeout"] = seconds(timeout, "--timeout", low=low, high=high)
    if retries is not None:
        low, high = limits_of(ClientParameters, "retries")
        options["retries"] = whole_number(retries, "--retries", int(low), int(high))
    number = None if unit is None else whole_number(unit, "--unit", 0, 255)
    show_traffic(verbose)
    with connect(url, **options) as link:
        yield link.unit(number)


def show_traffic(verbose: int) -> None:
    """Log the traffic of all connections of this process on stderr from now on.

    Args:
        verbose: how often ``-v`` was given. 0: nothing is logged; 1: messages; 2: frames too; 3 and more: every byte.
    """
    if not verbose:
        return
    import logging

    from ..observe.trace import TRACE, TraceLevel

    TRACE.set(TraceLevel(min(verbose, TraceLevel.BYTES)))
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s.%(msecs)03d %(message)s", "%H:%M:%S"))
    logger = logging.getLogger("busway.trace")
    logger.handlers[:] = [handler]
    logger.propagate = False


def check_order(place: "Address", form: "ValueType[Any] | None", order: str) -> None:
    """Check that the option ``--order`` has an effect on the values at an address.

    Args:
        place: the address.
        form: the value type, created with this order; None for one bit.
        order: the text of ``--order``; ``ABCD``, the default, is always accepted.

    Raises:
        ConfigError: the value is one bit, or one register whose bytes the order does not swap.
    """
    if order == "ABCD":
        return
    if form is None or place.bit is not None:
        raise ConfigError(f"{place} is one bit and has no order", key="--order")
    if form.registers == 1 and form.order in ("", "AB"):
        raise ConfigError(
            f"{order} has no effect on {form.name}, which is one register; a type of several goes with it, "
            "such as --type float32",
            key="--order",
        )
