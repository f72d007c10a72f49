"""Foreign programs on serial lines: which there are, and how each is started at a port. Knows `foreign` and lines.

Each pair of programs has a line of its own, because a serial line has one master: 115 200 baud, 8 data bits and no
parity, which is all that a pseudo-terminal has.
"""

import foreign

from busway.testing.line import PacedLine

UNIT = 1
BAUD = 115_200
OPTIONS = f"baud={BAUD}&parity=none"

SERVERS = ["libmodbus-rtu", "pymodbus-rtu", "pymodbus-ascii"]
CLIENTS = ["libmodbus-rtu", "pymodbus-rtu", "minimalmodbus-rtu", "pymodbus-ascii", "minimalmodbus-ascii"]


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


def new_line() -> PacedLine:
    return PacedLine(ports=2, baud=BAUD, parity="none")
