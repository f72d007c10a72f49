"""minimalmodbus as the master of a serial line, one read after the other.

Run by the peers' interpreter from `bench/`: python -m peers.minimalmodbus_line_client PATH BAUD READS REGISTERS

A pseudo-terminal has no parity, so it is told 8N2, whose characters have the same length as those of 8E1.
"""

import sys

import minimalmodbus
from harness.reads import Reads


def main(path: str, baud: int, reads: Reads, registers: int) -> None:
    instrument = minimalmodbus.Instrument(path, 1)
    instrument.serial.baudrate = baud
    instrument.serial.stopbits = 2
    instrument.serial.timeout = 3
    values = instrument.read_registers(0, registers)
    while reads.more(values):
        values = instrument.read_registers(0, registers)
    instrument.serial.close()


baud, count, registers = map(int, sys.argv[2:])
main(sys.argv[1], baud, Reads(count, registers), registers)
