"""The gateway's own unit: a device with the gateway's identification, diagnostics, and if wanted status registers.

Knows the values of a status as numbers; knows no upstream and no listener. Requests that no route takes reach the own
unit by its number, which is 255 by default, and by unit 0 if they are no broadcast (T32).

By default there are no status registers, and a read gets exception 01: a client that names no unit asks unit 255, and
must not take the status of the gateway for values of a device.

``REGISTERS`` is the register map; the table in the documentation is generated from it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from ...codes import FunctionCode
from ...server.device import Device
from ...server.hooks import Access
from ...version import __version__

FIRST_UPSTREAM: Final = 100
"""Address of the first upstream's first register, counted from 0."""
PER_UPSTREAM: Final = 16
"""Number of registers between the first register of one upstream and that of the next."""
MOST_UPSTREAMS: Final = 64
FUNCTIONS: Final = (
    FunctionCode.DIAGNOSTICS,
    FunctionCode.GET_COMM_EVENT_COUNTER,
    FunctionCode.GET_COMM_EVENT_LOG,
    FunctionCode.REPORT_SERVER_ID,
    FunctionCode.ENCAPSULATED_INTERFACE,
)
"""Functions that the own unit has, with and without status registers."""
STATES: Final = ("down", "backing off", "connecting", "suspect", "up")
"""States of a connection, from worst to best; the position is the number in the status register."""


@dataclass(frozen=True, slots=True)
class StatusRegister:
    """One value in the status registers of the gateway's own unit: address, width and meaning.

    Attributes:
        address: address of the first input register, counted from 0; in `UPSTREAM_REGISTERS` relative to
            the upstream's first register.
        registers: number of registers, 1 or 2; of two registers the first has the high 16 bits.
        name, meaning: name and meaning of the value, for the table of the documentation.
    """

    address: int
    registers: int
    name: str
    meaning: str


REGISTERS: Final = (
    StatusRegister(0, 2, "uptime", "seconds since the start"),
    StatusRegister(2, 1, "listeners", "number of listeners"),
    StatusRegister(3, 1, "upstreams", "number of upstreams"),
    StatusRegister(4, 2, "connections", "clients connected now"),
    StatusRegister(6, 2, "requests", "requests received"),
    StatusRegister(8, 2, "no_route", "requests for which there was no route (0A)"),
)
UPSTREAM_REGISTERS: Final = (
    StatusRegister(0, 1, "state", "0 down, 1 backing off, 2 connecting, 3 suspect, 4 up: of its best connection"),
    StatusRegister(1, 1, "in_flight", "requests whose reply is awaited"),
    StatusRegister(2, 1, "queued", "requests that wait for their turn"),
    StatusRegister(3, 1, "suspended", "units that are not asked now, because they do not answer"),
    StatusRegister(4, 2, "forwarded", "requests accepted by the link"),
    StatusRegister(6, 2, "answered", "requests answered by a device"),
    StatusRegister(8, 2, "exceptions", "requests that a device refused"),
    StatusRegister(10, 2, "no_answer", "requests answered 0B"),
    StatusRegister(12, 2, "no_path", "requests answered 0A"),
    StatusRegister(14, 2, "spared", "reads answered by another's, or from memory"),
)

StatusNumbers = Callable[[], tuple[Sequence[int], Sequence[Sequence[int]]]]
"""Function that returns two lists: the values of `REGISTERS`, and for each upstream those of `UPSTREAM_REGISTERS`."""


def own_device(numbers: StatusNumbers, *, registers: bool = False) -> Device:
    """Create the device that answers for the gateway itself: identification, diagnostics, status registers.

    Args:
        numbers: returns the values of the status registers; called before each read of input registers. Only the first
            64 upstreams (`MOST_UPSTREAMS`) have registers.
        registers: whether the device has the status in input registers; without them a read gets exception 01. A value
            that one register cannot hold is shown as 65535; of values in two registers the low 32 bits are shown.
    """
    device = Device(
        input_registers=FIRST_UPSTREAM + MOST_UPSTREAMS * PER_UPSTREAM if registers else 0,
        identification={0: "busway", 1: "gateway", 2: __version__, 4: "busway gateway"},
        server_id=b"busway gateway\xff",
        functions=(*FUNCTIONS, FunctionCode.READ_INPUT_REGISTERS) if registers else FUNCTIONS,
    )
    if not registers:
        return device

    def refresh(access: Access) -> None:
        own, upstreams = numbers()
        with device.update():
            _put(device, 0, REGISTERS, own)
            for index, upstream in enumerate(upstreams[:MOST_UPSTREAMS]):
                _put(device, FIRST_UPSTREAM + index * PER_UPSTREAM, UPSTREAM_REGISTERS, upstream)

    device.on_read("input_registers", refresh, when="before")
    return device


def _put(device: Device, start: int, entries: Sequence[StatusRegister], values: Sequence[int]) -> None:
    for entry, value in zip(entries, values, strict=True):
        at = start + entry.address
        if entry.registers == 2:
            device.input_registers[at : at + 2] = [value >> 16 & 0xFFFF, value & 0xFFFF]
        else:
            device.input_registers[at] = min(value, 0xFFFF)
