"""A test device whose every value follows from its address, so that tests know it without reading."""

from ..server.device import Device
from ..server.table_declaration import Cells

ITEMS = 1000
"""Number of items in each table of `known_device` by default."""


def known_device(items: int = ITEMS) -> Device:
    """Create a device with all tables, a file and a queue, and values that follow from the addresses.

    Holding register ``n`` holds ``n``, input register ``n`` holds ``10000 + n``, coil ``n`` is on where ``n`` is even,
    discrete input ``n`` where ``n`` is a multiple of 3. The last ten holding registers and coils are read-only. File 1
    has 100 records that hold their number, the queue at 10 holds 1, 2, 3, and identification objects 0…2 and 0x80
    are there.

    Args:
        items: number of items in each table, 20…50000.
    """
    return Device(
        holding_registers=Cells(values=list(range(items)), read_only=[(items - 10, 10)]),
        input_registers=[10_000 + number for number in range(items)],
        coils=Cells(values=[number % 2 == 0 for number in range(items)], read_only=[(items - 10, 10)]),
        discrete_inputs=[number % 3 == 0 for number in range(items)],
        files={1: list(range(100))},
        fifos={10: [1, 2, 3]},
        identification={0: "busway", 1: "known device", 2: "1.0", 0x80: b"\x01\x02"},
        exception_status=0x5A,
        server_id=b"known\xff",
    )
