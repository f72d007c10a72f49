"""Checks of the functions that write: 05, 06, 15, 16, 22 and 23.

They write to the scratch items only. If a device that wrongly executes an invalid request could write elsewhere, the
check is of the level disruptive; so is the broadcast, which other units of the line execute too.
"""

from typing import Final, Protocol

from ....codes import BROADCAST_UNIT, Table
from ..check import Accepts, Ask, Check, Items, Level, Target
from .shorthand import MUST, SHOULD, SILENCE, check, pdu, refused, refused_or_silent, reply_or, word

_REFUSED: Final = refused(3)
_READ: Final = {Table.COILS: 1, Table.HOLDING_REGISTERS: 3}


def write_checks(target: Target) -> list[Check]:
    """Return the checks that write to the scratch registers and coils of a target; an empty list if it has neither."""
    checks: list[Check] = []
    if target.registers is not None:
        checks += [*_single_register(target.registers), *_registers(target.registers), *_mask(target.registers)]
        checks += _read_write(target.registers)
        if target.framing != "mbap":
            checks += _broadcast(target.registers)
    if target.coils is not None:
        checks += [*_single_coil(target.coils), *_coils(target.coils)]
    return checks


def _holds(items: Items, data: bytes, count: int) -> Ask:
    """Return a step that reads the first ``count`` scratch items and accepts only ``data`` as their values."""
    code = _READ[items.table]
    return Ask(pdu(code, items.address, count), Accepts(reply=True, exact=bytes((code, len(data))) + data))


def _write(request: bytes, size: int | None = None) -> Ask:
    """Return a step that sends a write request and accepts only the reply that repeats its first ``size`` bytes.

    None for ``size``: the reply repeats the whole request.
    """
    return Ask(request, Accepts(reply=True, exact=request if size is None else request[:size]))


class _Maker(Protocol):
    """Interface of a function that creates a check of one function code.

    ``what`` is the end of the check's name, ``says`` its sentence, ``opens`` as of `Check`. ``should``: it is a should.
    """

    def __call__(
        self,
        what: str,
        says: str,
        *steps: Ask,
        opens: bool = False,
        should: bool = False,
        level: Level = ...,
        clause: str = ...,
    ) -> Check: ...


def _one(function: int, of: str) -> _Maker:
    """Return a function that creates checks of one function code; ``of`` is the clause of those that name none."""

    def make(
        what: str,
        says: str,
        *steps: Ask,
        opens: bool = False,
        should: bool = False,
        level: Level = Level.WRITE,
        clause: str = of,
    ) -> Check:
        strength = SHOULD if should else MUST
        return check(
            f"fc{function:02}-{what}",
            clause,
            says,
            *steps,
            level=level,
            function=function,
            opens=opens,
            strength=strength,
        )

    return make


def _single_register(items: Items) -> list[Check]:
    one, at = _one(6, "A12"), items.address
    return [
        one("echo", "echoes the write of a register", _write(pdu(6, at, 0x1234)), opens=True),
        one("written", "holds what was written", _write(pdu(6, at, 0xA55A)), _holds(items, b"\xa5\x5a", 1)),
        one("zero", "takes the value 0", _write(pdu(6, at, 0)), _holds(items, bytes(2), 1)),
        one(
            "cut",
            "does not execute a write whose value is cut: 03, or silence",
            _write(pdu(6, at, 0x1111)),
            Ask(pdu(6, at, b"\x22"), refused_or_silent(3)),
            _holds(items, b"\x11\x11", 1),
            should=True,
        ),
        one(
            "byte-too-many",
            "does not execute a write with a byte too many: 03, or silence",
            _write(pdu(6, at, 0x1111)),
            Ask(pdu(6, at, 0x2222, b"\x00"), refused_or_silent(3)),
            _holds(items, b"\x11\x11", 1),
            should=True,
        ),
    ]


def _registers(items: Items) -> list[Check]:
    one, at = _one(16, "A14"), items.address
    known = _write(pdu(16, at, 2, b"\x04", 0x1111, 0x2222), 5)
    kept = _holds(items, b"\x11\x11\x22\x22", 2)

    def unchanged(request: bytes, accepts: Accepts = _REFUSED) -> tuple[Ask, ...]:
        return known, Ask(request, accepts), kept

    return [
        one("answers", "answers a write of two registers with address and count", known, opens=True),
        one("written", "holds what was written", known, kept),
        one(
            "all",
            "takes all registers of the scratch in one request",
            _write(pdu(16, at, items.count, bytes((2 * items.count,)), bytes(2 * items.count)), 5),
        ),
        one("count-0", "refuses a count of 0 with 03 and writes nothing", *unchanged(pdu(16, at, 0, b"\x00"))),
        one(
            "byte-count-under",
            "refuses a byte count below that of the count with 03 and writes nothing",
            *unchanged(pdu(16, at, 2, b"\x02", 0x3333)),
        ),
        one(
            "byte-count-over",
            "refuses a byte count above that of the count with 03 and writes nothing",
            *unchanged(pdu(16, at, 1, b"\x04", 0x3333, 0x4444)),
        ),
        one(
            "byte-count-odd",
            "refuses an odd byte count with 03 and writes nothing",
            *unchanged(pdu(16, at, 1, b"\x03", 0x3333, b"\x44")),
        ),
        one(
            "data-cut",
            "does not write where data are missing: 03, or silence",
            *unchanged(pdu(16, at, 2, b"\x04", 0x3333), refused_or_silent(3)),
        ),
        one(
            "byte-too-many",
            "does not write where a byte is too many: 03, or silence",
            *unchanged(pdu(16, at, 1, b"\x02", 0x3333, b"\x44"), refused_or_silent(3)),
            should=True,
        ),
        one(
            "count-over",
            "refuses 124 registers with 03",
            Ask(pdu(16, at, 124, b"\xf6", bytes(246)), refused(3)),
            level=Level.DISRUPTIVE,
        ),
        one(
            "beyond-end",
            "refuses a range that ends beyond 65535 with 02",
            Ask(pdu(16, 0xFFFF, 2, b"\x04", 0, 0), refused(2)),
            level=Level.DISRUPTIVE,
            clause="A7",
        ),
    ]


def _mask(items: Items) -> list[Check]:
    one, at = _one(22, "A17"), items.address
    request = pdu(22, at, 0x00F2, 0x0025)
    return [
        one("echo", "echoes the request", _write(request), opens=True),
        one(
            "effect",
            "writes (current AND mask) OR (mask AND NOT mask): 12 becomes 17",
            _write(pdu(16, at, 1, b"\x02", 0x0012), 5),
            _write(request),
            _holds(items, b"\x00\x17", 1),
        ),
        one(
            "cut",
            "does not execute a request whose mask is missing: 03, or silence",
            Ask(pdu(22, at, 0x00F2), refused_or_silent(3)),
            should=True,
        ),
    ]


def _read_write(items: Items) -> list[Check]:
    one, at = _one(23, "A18"), items.address
    known = _write(pdu(16, at, 2, b"\x04", 0x1111, 0x2222), 5)
    kept = _holds(items, b"\x11\x11\x22\x22", 2)

    def request(read: int, written: int, count: int, data: bytes, first: int = at) -> bytes:
        return pdu(23, first, read, at, written, bytes((count,)), data)

    def unchanged(bad: bytes, *codes: int) -> tuple[Ask, ...]:
        return known, Ask(bad, refused(*codes)), kept

    new = word(0x3333) + word(0x4444)
    return [
        one(
            "answers",
            "answers a read and write of the same registers",
            Ask(request(2, 2, 4, new), reply_or()),
            opens=True,
        ),
        one(
            "write-first",
            "writes before it reads",
            known,
            Ask(request(2, 2, 4, new), Accepts(reply=True, exact=b"\x17\x04" + new)),
        ),
        one("read-0", "refuses to read 0 registers with 03 and writes nothing", *unchanged(request(0, 2, 4, new), 3)),
        one(
            "read-over",
            "refuses to read 126 registers with 03 and writes nothing",
            *unchanged(request(126, 2, 4, new), 3),
        ),
        one("write-0", "refuses to write 0 registers with 03", *unchanged(request(2, 0, 0, b""), 3)),
        one(
            "byte-count-under",
            "refuses a byte count below that of the count with 03 and writes nothing",
            *unchanged(request(2, 2, 2, new[:2]), 3),
        ),
        one(
            "byte-count-over",
            "refuses a byte count above that of the count with 03 and writes nothing",
            *unchanged(request(2, 1, 4, new), 3),
        ),
        one(
            "read-beyond",
            "refuses to read beyond 65535 with 02 and writes nothing",
            *unchanged(request(2, 2, 4, new, 0xFFFF), 2),
            clause="A7",
        ),
    ]


def _broadcast(items: Items) -> list[Check]:
    at = items.address
    return [
        check(
            "broadcast-write",
            "S2",
            "executes a write that is sent to all, and does not answer",
            _write(pdu(16, at, 1, b"\x02", 0x1111), 5),
            Ask(pdu(16, at, 1, b"\x02", 0x5AA5), SILENCE, unit=BROADCAST_UNIT),
            _holds(items, b"\x5a\xa5", 1),
            level=Level.DISRUPTIVE,
        ),
    ]


def _single_coil(items: Items) -> list[Check]:
    one, at = _one(5, "A11"), items.address
    on, off = pdu(5, at, 0xFF00), pdu(5, at, 0)
    return [
        one("echo", "echoes the write of a coil", _write(on), opens=True),
        one("on", "is on after FF00", _write(on), _holds(items, b"\x01", 1)),
        one("off", "is off after 0000", _write(off), _holds(items, b"\x00", 1)),
        *(
            one(
                f"value-{value:04x}",
                f"refuses the value {value:04X} with 03 and writes nothing",
                _write(off),
                Ask(pdu(5, at, value), refused(3)),
                _holds(items, b"\x00", 1),
            )
            for value in (0x0001, 0x00FF, 0x1234, 0xFF01, 0xFFFF)
        ),
        one(
            "cut",
            "does not execute a write whose value is cut: 03, or silence",
            _write(off),
            Ask(pdu(5, at, b"\xff"), refused_or_silent(3)),
            _holds(items, b"\x00", 1),
            should=True,
        ),
    ]


def _coils(items: Items) -> list[Check]:
    one, at = _one(15, "A13"), items.address
    known = _write(pdu(15, at, 2, b"\x01\x01"), 5)
    kept = _holds(items, b"\x01", 2)

    def unchanged(request: bytes, accepts: Accepts = _REFUSED) -> tuple[Ask, ...]:
        return known, Ask(request, accepts), kept

    return [
        one("answers", "answers a write of two coils with address and count", known, opens=True),
        one("written", "holds what was written", known, kept),
        one("count-0", "refuses a count of 0 with 03 and writes nothing", *unchanged(pdu(15, at, 0, b"\x00"))),
        one(
            "byte-count-0", "refuses a byte count of 0 with 03 and writes nothing", *unchanged(pdu(15, at, 2, b"\x00"))
        ),
        one(
            "byte-count-over",
            "refuses a byte count above that of the count with 03 and writes nothing",
            *unchanged(pdu(15, at, 2, b"\x02\x02\x00")),
            level=Level.WRITE if items.count >= 2 * 8 else Level.DISRUPTIVE,  # a device may go by the byte count
        ),
        one(
            "data-cut",
            "does not write where data are missing: 03, or silence",
            *unchanged(pdu(15, at, 2, b"\x01"), refused_or_silent(3)),
        ),
        one(
            "count-over",
            "refuses 1969 coils with 03",
            Ask(pdu(15, at, 1969, b"\xf7", bytes(246)), refused(3)),
            level=Level.DISRUPTIVE,
        ),
        one(
            "beyond-end",
            "refuses a range that ends beyond 65535 with 02",
            Ask(pdu(15, 0xFFFF, 2, b"\x01\x00"), refused(2)),
            level=Level.DISRUPTIVE,
            clause="A7",
        ),
    ]
