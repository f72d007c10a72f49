"""Published programs that use pymodbus, unmodified: over busway they print what they print over pymodbus.

Each reads the same server twice, once with each library underneath. Each needs the release of pymodbus that it was
written for; all of them run over the same modules of busway.
"""

import os
import subprocess
import sys
from pathlib import Path

import foreign
import pytest

import busway

PROGRAMS = foreign.CHECKOUT / ".peers" / "programs"
RELEASES = foreign.CHECKOUT / ".peers" / "pymodbus"
ITEMS = 0x10000
POINTS = """\
device,pump,1,,
poll,coil,8,24,BE_BE
ref,valves,8,bool8,r
poll,discrete_input,0,16,BE_BE
ref,alarms,0,bool16,r
poll,holding_register,100,20,BE_BE
ref,speed,100,uint16,rw,rpm,0.5
ref,torque,101,int16,r
ref,energy,102,uint32,r,kWh
ref,flow,104,float32,r
ref,total,106,uint64,r
ref,name,110,string8,r
ref,ready,114:3,bool,r
poll,input_register,10,8,LE_LE
ref,level,10,float32,r
ref,signed,12,int32,r
ref,long,14,int64,r
poll,holding_register,100,4,BE_LE
ref,swapped,100,float32,r
device,absent,9,,
poll,holding_register,0,2,BE_BE
ref,nothing,0,uint16,r
"""


def content(unit: int) -> busway.Device:
    """A device whose registers hold letters, so that every text and every number in them can be read."""
    registers = [0x4141 + 257 * ((address + unit) % 23) + address % 7 for address in range(ITEMS)]
    return busway.Device(
        holding_registers=registers,
        input_registers=registers,
        coils=[address % 3 == 0 for address in range(100)],
        discrete_inputs=[address % 5 < 2 for address in range(100)],
    )


def units() -> dict[int, busway.Device]:
    """Devices with their first content. 0 is the unit of a call that names none, until pymodbus 3.6; later it is 1."""
    meter = content(1)
    return {0: meter, 1: meter, 200: content(200)}


def printed(over: str, release: str, words: list[str], folder: Path) -> str:
    """What a program prints over the original of a release, or over busway; a port in ``words`` is that of a server."""
    if not PROGRAMS.is_dir():
        foreign.missing(f"no {PROGRAMS.relative_to(foreign.CHECKOUT)}: run make peers")
    interpreter = [sys.executable, "-W", "error::ResourceWarning"] if over == "BUSWAY" else [foreign.PEER_PYTHON]
    libraries = [PROGRAMS] if over == "BUSWAY" else [PROGRAMS, RELEASES / release]
    with busway.serve_in_thread("tcp://127.0.0.1:0", units=units()) as server:
        port = server.endpoints[0].rpartition(":")[2]
        done = subprocess.run(
            [
                *interpreter,
                foreign.PEERS / "program.py",
                over,
                "pymodbus",
                *(word.replace("PORT", port) for word in words),
            ],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, libraries))},
            capture_output=True,
            text=True,
            timeout=foreign.LIMIT,
            check=False,
        )
    assert done.returncode == 0, f"{over}: {done.stderr}"
    return done.stdout.replace(f":{port}", ":PORT")


@pytest.mark.parametrize(
    ("program", "release", "least"),
    [("sdm_modbus", "3.6.9", 70), ("solaredge_modbus", "3.6.9", 40), ("alfen_eve_modbus_tcp", "3.16.1", 40)],
)
def test_library_reads_and_writes_over_busway_what_it_does_over_pymodbus(
    program: str, release: str, least: int, tmp_path: Path
) -> None:
    original = printed("ORIGINAL", release, [program, "PORT"], tmp_path)
    assert len(original.splitlines()) > least
    assert printed("BUSWAY", release, [program, "PORT"], tmp_path) == original


def test_modpoll_prints_over_busway_what_it_prints_over_pymodbus(tmp_path: Path) -> None:
    points = tmp_path / "points.csv"
    points.write_text(POINTS, encoding="utf-8")
    words = ["modpoll", "--tcp", "127.0.0.1", "--tcp-port", "PORT", "-f", str(points), "--once", "--interval", "0"]
    original = printed("ORIGINAL", "3.9.2", words, tmp_path)
    assert "torque" in original
    assert printed("BUSWAY", "3.9.2", words, tmp_path) == original
