"""``busway identify``: shows how a device identifies itself.

1. Device identification (43/14), of the highest level that the device has. Some devices refuse a level above their own,
   so the levels are tried from the highest down.
2. Report server id (17).
3. If a device does not offer one of the two functions, stderr says so; it is an error only if it offers neither. If
   the device answers neither, or a gateway cannot reach it, there is one error, and nothing is said of what it offers.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from ..codes import ExceptionCode
from ..errors import ConfigError, ExceptionReply, InvalidRequest, LinkDown, ModbusError, NoReply
from .arguments import CAPTURE, CSV, JSON, RETRIES, TIMEOUT, UNIT, URL, VERBOSE, opened_unit
from .exits import ExitCode
from .files import capturing
from .output import print_aligned, print_csv, print_json, shown_value, warn

if TYPE_CHECKING:
    from ..client.blocking import BlockingUnit

EXAMPLES = """\b
Examples:
  busway identify tcp://10.0.0.5
  busway identify tcp://10.0.0.5 --unit 3 --json
"""

IdentityFact = tuple[str, str, bytes]
"""One value that identifies a device: function (``43/14`` or ``17``), name of the object, and its bytes."""

LEVELS: Final = ("extended", "regular", "basic")
_LATER: Final = (ExceptionCode.ACKNOWLEDGE, ExceptionCode.SERVER_DEVICE_BUSY)
"""Exception codes of a device that has the function, and has no time for it now."""


def identify(
    url: str = URL,
    unit: str | None = UNIT,
    as_json: bool = JSON,
    as_csv: bool = CSV,
    timeout: str | None = TIMEOUT,
    retries: str | None = RETRIES,
    capture: str | None = CAPTURE,
    verbose: int = VERBOSE,
) -> int:
    """Ask a device what it is (functions 43/14 and 17)."""
    if as_json and as_csv:
        raise ConfigError("does not go with --json", key="--csv")
    facts: list[IdentityFact] = []
    failures: dict[str, ModbusError] = {}
    questions: tuple[tuple[str, Callable[[BlockingUnit], list[IdentityFact]]], ...] = (
        ("device identification (43/14)", _identification),
        ("server id (17)", _server_id),
    )
    with (
        capturing(capture),
        opened_unit(url, unit=unit, timeout=timeout, retries=retries, verbose=verbose) as asked,
    ):
        for name, ask in questions:
            try:
                facts += ask(asked)
            except (LinkDown, InvalidRequest, ConfigError):
                raise
            except ModbusError as error:
                failures[name] = error
    errors = list(failures.values())
    if len(errors) == len(questions) and all(_is_absence(one) for one in errors):
        raise errors[0]
    for name, failure in failures.items():
        warn(f"{name}{_verdict(failure)}: {failure}")
    if len(errors) == len(questions):
        raise errors[0]
    _show(facts, as_json=as_json, as_csv=as_csv)
    return ExitCode.DONE


def _is_absence(error: ModbusError) -> bool:
    """Whether the device has not answered: no reply came, or a gateway answered that it cannot reach the device."""
    return isinstance(error, NoReply) or (isinstance(error, ExceptionReply) and error.from_gateway)


def _verdict(error: ModbusError) -> str:
    """Return what a failed request says of its function; empty if nothing, as with a busy device or a broken reply."""
    if _is_absence(error):
        return " is not answered"
    return " is not offered" if isinstance(error, ExceptionReply) and error.code not in _LATER else ""


def _identification(unit: "BlockingUnit") -> list[IdentityFact]:
    from ..pdu.encapsulated import OBJECT_NAMES

    for level in LEVELS:
        try:
            objects = unit.read_device_identification(level)
        except ExceptionReply as error:
            if level == LEVELS[-1] or _is_absence(error):
                raise
        else:
            break
    return [
        ("43/14", OBJECT_NAMES.get(number, f"object 0x{number:02X}"), value)
        for number, value in sorted(objects.items())
    ]


def _server_id(unit: "BlockingUnit") -> list[IdentityFact]:
    return [("17", "ServerId", unit.report_server_id())]


def _show(facts: list[IdentityFact], *, as_json: bool, as_csv: bool) -> None:
    if as_json:
        for function, name, value in facts:
            print_json({"function": function, "name": name, "value": _text(value), "raw": value.hex()})
    elif as_csv:
        print_csv(["function", "name", "value", "raw"], [[*fact[:2], _text(fact[2]), fact[2].hex()] for fact in facts])
    else:
        print_aligned([[function, name, _with_raw(value)] for function, name, value in facts])


def _with_raw(value: bytes) -> str:
    """Return an identification value as text, with its bytes in hexadecimal behind it if the text does not show all."""
    text = _text(value)
    return text if text.encode() == value and text.isprintable() else f"{text}  [{value.hex(' ')}]"


def _text(value: bytes) -> str:
    return shown_value(value.decode("utf-8", errors="backslashreplace"))
