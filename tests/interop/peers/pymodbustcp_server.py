"""A Modbus server made of pyModbusTCP, for the interop tests: ``pymodbustcp_server.py PORT``; port 0 takes a free one.

Prints ``ready PORT``. Four tables of 1000 items with the known content, on every unit.
"""

import sys
import threading

from conversation import COILS, DISCRETE_INPUTS, HOLDING_REGISTERS, IDENTITY, INPUT_REGISTERS, ITEMS, say
from pyModbusTCP.server import DataBank, DeviceIdentification, ModbusServer


def main() -> None:
    bank = DataBank(coils_size=ITEMS, d_inputs_size=ITEMS, h_regs_size=ITEMS, i_regs_size=ITEMS)
    bank.set_coils(0, COILS)
    bank.set_discrete_inputs(0, DISCRETE_INPUTS)
    bank.set_holding_registers(0, HOLDING_REGISTERS)
    bank.set_input_registers(0, INPUT_REGISTERS)
    identity = DeviceIdentification(objects_id={number: text.encode() for number, text in IDENTITY.items()})
    server = ModbusServer("127.0.0.1", int(sys.argv[1]), no_block=True, data_bank=bank, device_id=identity)
    server.start()
    say(f"ready {server._service.server_address[1]}")  # the chosen port has no public name
    threading.Event().wait()


main()
