"""sdm_modbus on a paced line: over busway's serial clients it prints what it prints over those of pymodbus."""

import os
import subprocess
import sys

import foreign
from serial_peers import BAUD, UNIT

import busway
from busway.testing.line import PacedLine

PROGRAMS = foreign.CHECKOUT / ".peers" / "programs"
RELEASE = foreign.CHECKOUT / ".peers" / "pymodbus" / "3.6.9"


def meter() -> busway.Device:
    """A device whose every two registers are a float."""
    device = busway.Device(holding_registers=0x200, input_registers=0x200)
    device.holding_registers[:] = [0x4100 + address % 50 for address in range(0x200)]
    device.input_registers[:] = [0x4200 + address % 70 for address in range(0x200)]
    return device


def test_sdm_modbus_reads_a_line_over_busway_as_it_does_over_pymodbus() -> None:
    if not PROGRAMS.is_dir():
        foreign.missing(f"no {PROGRAMS.relative_to(foreign.CHECKOUT)}: run make peers")
    printed = []
    for over, interpreter, libraries in (
        ("ORIGINAL", foreign.PEER_PYTHON, (PROGRAMS, RELEASE)),
        ("BUSWAY", sys.executable, (PROGRAMS,)),
    ):
        with PacedLine(ports=2, baud=BAUD, parity="none") as line:
            url = f"rtu://{line.paths[1]}?baud={BAUD}&parity=none"
            with busway.serve_in_thread(url, units={UNIT: meter()}):
                done = subprocess.run(
                    [interpreter, foreign.PEERS / "program.py", over, "pymodbus", "sdm_modbus_rtu", line.paths[0]],
                    env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, libraries))},
                    capture_output=True,
                    text=True,
                    timeout=foreign.LIMIT,
                    check=False,
                )
        assert done.returncode == 0, f"{over}: {done.stderr}"
        printed.append(done.stdout)
    assert len(printed[0].splitlines()) > 70
    assert printed[1] == printed[0]
