"""minimalmodbus as the master of a serial line, one read after the other; it opens the port for each turn.

Run by the peers' interpreter from `bench/`: python -m peers.minimalmodbus_line_client PATH BAUD READS REGISTERS;
see `harness.turns`.

A pseudo-terminal has no parity, so it is told 8N2, whose characters have the same length as those of 8E1.
"""

import sys

import minimalmodbus
from harness.priority import PROGRAM, real_time
from harness.reads import Reads
from harness.turns import Took, make_turns


def turn(path: str, baud: int, count: int, registers: int) -> Took:
    reads = Reads(count, registers)
    instrument = minimalmodbus.Instrument(path, 1)
    try:
        instrument.serial.baudrate = baud
        instrument.serial.stopbits = 2
        instrument.serial.timeout = 3
        values = instrument.read_registers(0, registers)
        while reads.more(values):
            values = instrument.read_registers(0, registers)
    finally:
        instrument.serial.close()
    return reads.took()


real_time(PROGRAM)
make_turns(lambda: turn(sys.argv[1], *map(int, sys.argv[2:])))
