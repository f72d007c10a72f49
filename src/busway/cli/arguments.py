"""Options that several commands share, and the conversion of their texts to checked values.

Knows how an argument is written and named in a sentence; sends nothing.
"""

import contextlib
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import typer

from ..errors import ConfigError
from ..values.durations import duration

if TYPE_CHECKING:
    from ..client.blocking import BlockingUnit

URL = typer.Argument(..., metavar="URL", help="The device: tcp://10.0.0.5, tcp://host:5020.")
UNIT = typer.Option(None, "-u", "--unit", metavar="U", help="Unit identifier, 0…255. On TCP 255, the device itself.")
TYPE = typer.Option(
    None,
    "-t",
    "--type",
    metavar="TYPE",
    help="int16…int64, uint16…uint64, float16…float64, bcd16…bcd64, string:N, bits.",
)
ORDER = typer.Option("ABCD", "--order", metavar="ORDER", help="Order of bytes and registers: ABCD, CDAB, BADC, DCBA…")
TIMEOUT = typer.Option(None, "--timeout", metavar="TIME", help="Wait this long for a reply, for each attempt: 1s.")
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


def whole_number(text: str, name: str, low: int, high: int) -> int:
    """Return the number in an option's text, decimal or ``0x…``; `ConfigError` names option and range."""
    number = int(text, 16 if text[:2].lower() == "0x" else 10) if _NUMBER.fullmatch(text) else -1
    if not low <= number <= high:
        raise ConfigError(f"a whole number {low}…{high} is needed, not {text!r}", key=name)
    return number


def seconds(text: str, name: str, *, low: float = 0.001, high: float = 86_400) -> float:
    """Parse a duration in seconds: ``500ms``, ``1s``, ``2`` (seconds), ``1h``. `ConfigError` names the option."""
    time = duration(text, bare=True)
    if time is None:
        raise ConfigError(f"a time such as 500ms, 1s or 2m is needed, not {text!r}", key=name)
    if not low <= time <= high:
        raise ConfigError(f"a time of {low:g}…{high:g} s is needed, not {text!r}", key=name)
    return time


def limits_of(kind: type[Any], option: str) -> tuple[float, float]:
    """Return the smallest and the largest number that an option of a parameter class accepts."""
    from ..options.declaration import Range, declared

    limits = declared(kind)[option].limits
    assert isinstance(limits, Range)
    return limits.low, limits.high


def refuse_unknown_option(value: str) -> None:
    """Refuse an argument that is a misspelt option; a minus sign may begin a number or ``-inf``."""
    if re.match(r"--?[a-zA-Z]", value) and value.lower() not in ("-inf", "-infinity", "-nan"):
        raise ConfigError(f"there is no such option; a text that begins so is written behind --: -- {value}", key=value)


@contextlib.contextmanager
def opened_unit(
    url: str, *, unit: str | None, timeout: str | None, retries: str | None, verbose: int
) -> Iterator["BlockingUnit"]:
    """Context manager that opens a blocking link to a URL and yields one of its units; nothing is sent yet.

    Raises:
        ConfigError, InvalidRequest: invalid URL or option.
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
    """Log messages (1), frames (2) or bytes (3 and more) of all connections on stderr from now on."""
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
