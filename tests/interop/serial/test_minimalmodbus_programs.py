"""Programs that use minimalmodbus, unmodified: over busway they get what they get over the original, on paced lines."""

import os
import subprocess
import sys

import foreign
import pytest
from serial_peers import BAUD, UNIT, our_server

import busway
from busway.testing.line import PacedLine

PROGRAMS = foreign.CHECKOUT / ".peers" / "programs"
QUESTIONS = [
    "read_coils 0 17",
    "read_discrete_inputs 3 40",
    "read_holding_registers 0 125",
    "read_input_registers 10 1",
    "read_holding_registers 990 20",  # beyond the end: an exception
    "write_single_coil 900 1",
    "write_single_register 900 17",
    "function_15 901 1",
    "function_16 901 18",
    "write_multiple_coils 902 1 0 1",
    "write_multiple_registers 902 5 6 7",
    "write_float 910 -5",
    "read_float 910",
    "read_coils 900 5",
    "read_holding_registers 900 12",
    "broadcast_register 920 99",
    "read_holding_registers 920 1",
]


def over_busway(*words: object) -> foreign.Program:
    """A peer of the other tests, with busway in the place of minimalmodbus."""
    return foreign.Program([sys.executable, foreign.PEERS / "program.py", "BUSWAY", "minimalmodbus", *map(str, words)])


@pytest.fixture(params=["rtu", "ascii"])
def framing(request: pytest.FixtureRequest) -> str:
    framing: str = request.param
    return framing


def test_every_method_gets_over_busway_what_it_gets_over_minimalmodbus(framing: str) -> None:
    answers = []
    for start in (lambda *words: foreign.python_peer("minimalmodbus_client.py", *words), over_busway):
        words = () if start is not over_busway else ("minimalmodbus_client",)
        with our_server(framing) as server, start(*words, framing, server.path, BAUD, UNIT) as program:
            answers.append([{**program.ask(question), "error": ""} for question in QUESTIONS])
    for question, original, ours in zip(QUESTIONS, *answers, strict=True):
        assert ours == original, question


def charge_controller() -> busway.Device:
    """A device that has what epevermodbus asks for."""
    content = [(address * 37 + 11) % 1000 + 2000 for address in range(0x10000)]
    content[0x3200:0x3203] = [0, 0, 0]  # states
    return busway.Device(
        holding_registers=content, input_registers=content, coils=[True] * 0x3000, discrete_inputs=[True] * 0x3000
    )


def test_epevermodbus_prints_over_busway_what_it_prints_over_minimalmodbus() -> None:
    if not PROGRAMS.is_dir():
        foreign.missing(f"no {PROGRAMS.relative_to(foreign.CHECKOUT)}: run make peers")
    printed = []
    for over, interpreter in (("ORIGINAL", foreign.PEER_PYTHON), ("BUSWAY", sys.executable)):
        with PacedLine(ports=2, baud=BAUD, parity="none") as line:
            url = f"rtu://{line.paths[1]}?baud={BAUD}&parity=none"
            with busway.serve_in_thread(url, units={UNIT: charge_controller()}):
                done = subprocess.run(
                    [
                        interpreter,
                        foreign.PEERS / "program.py",
                        over,
                        "minimalmodbus",
                        "epevermodbus",
                        line.paths[0],
                    ],
                    env={**os.environ, "PYTHONPATH": str(PROGRAMS)},
                    capture_output=True,
                    text=True,
                    timeout=foreign.LIMIT,
                    check=False,
                )
        assert done.returncode == 0, f"{over}: {done.stderr}"
        printed.append(done.stdout)
    assert len(printed[0].splitlines()) > 40
    assert printed[1] == printed[0]
