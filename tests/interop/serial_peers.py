"""Foreign programs on serial lines, and our server there. Knows `foreign`, paced lines and how our server is started.

1. Each pair of programs has a line of its own, because a serial line has one master: 115 200 baud, 8 data bits and no
   parity, which is all that a pseudo-terminal has.
2. What a foreign client wrote is looked up in our device: none of ours can ask beside the master.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import foreign

import busway
from busway.testing.line import PacedLine

UNIT = 1
BAUD = 115_200

SERVERS = ["libmodbus-rtu", "pymodbus-rtu", "pymodbus-ascii"]
CLIENTS = ["libmodbus-rtu", "pymodbus-rtu", "minimalmodbus-rtu", "pymodbus-ascii", "minimalmodbus-ascii"]


def new_line() -> PacedLine:
    """A line with two ends."""
    return PacedLine(ports=2, baud=BAUD, parity="none")


def url_of(framing: str, path: str) -> str:
    """The URL of a port for ours. Peers are told 8 data bits for ASCII too, as a pseudo-terminal refuses 7."""
    return f"{framing}://{path}?baud={BAUD}&parity=none&data_bits=8"


def start_server(kind: str, path: str) -> foreign.Program:
    """A foreign server for unit 1 at a port: ``library-framing``."""
    library, framing = kind.split("-")
    if library == "libmodbus":
        return foreign.c_peer("libmodbus_server", framing, path, BAUD, "N", UNIT)
    return foreign.python_peer(f"{library}_server.py", framing, path, BAUD, UNIT)


def start_client(kind: str, path: str) -> foreign.Program:
    """A foreign client of unit 1 at a port: ``library-framing``."""
    library, framing = kind.split("-")
    if library == "libmodbus":
        return foreign.c_peer("libmodbus_client", framing, path, BAUD, "N", UNIT)
    return foreign.python_peer(f"{library}_client.py", framing, path, BAUD, UNIT)


@dataclass(frozen=True, slots=True)
class OurServer:
    """Our server at one end of a line.

    Attributes:
        device: what it serves as unit 1.
        path: the other end.
    """

    device: busway.Device
    path: str


@contextmanager
def our_server(framing: str) -> Iterator[OurServer]:
    """Our server with a device of the known content."""
    device = busway.Device(
        **foreign.CONTENT, identification=foreign.IDENTITY, files={4: {7: [0, 0, 0]}}, fifos={40: [440, 4740]}
    )
    with new_line() as line, busway.serve_in_thread(url_of(framing, line.paths[1]), units={UNIT: device}):
        yield OurServer(device, line.paths[0])


@dataclass(frozen=True, slots=True)
class Pair:
    """A foreign client and our server on one line.

    Attributes:
        client: the program.
        device: what our server serves as unit 1.
    """

    client: foreign.Program
    device: busway.Device

    def ask(self, command: str) -> dict[str, Any]:
        """What the client makes of a command."""
        return self.client.ask(command)


@contextmanager
def our_pair(client: str) -> Iterator[Pair]:
    """A foreign client, ``library-framing``, on a line with our server."""
    with our_server(client.split("-")[1]) as server, start_client(client, server.path) as program:
        yield Pair(program, server.device)


class DeviceUnit:
    """Looks into a device with the names that a unit of our client has."""

    def __init__(self, device: busway.Device) -> None:
        self._device = device

    def read_coils(self, address: int, *, count: int) -> list[bool]:
        return [bool(one) for one in self._device.coils[address : address + count]]

    def read_holding_registers(self, address: int, *, count: int) -> list[int]:
        return list(self._device.holding_registers[address : address + count])

    def write_single_coil(self, address: int, value: bool) -> None:
        self._device.coils[address] = value

    def write_single_register(self, address: int, value: int) -> None:
        self._device.holding_registers[address] = value

    def write_multiple_registers(self, address: int, values: list[int]) -> None:
        self._device.holding_registers[address : address + len(values)] = values

    def read_file_record(self, file: int, record: int, *, count: int) -> list[int]:
        return list(self._device.files[file][record : record + count])

    def read_exception_status(self) -> int:
        return self._device.exception_status()

    def report_server_id(self) -> bytes:
        return self._device.server_id()
