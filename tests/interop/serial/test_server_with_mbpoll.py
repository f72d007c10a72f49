"""Our server on an RTU line against mbpoll, the command that people reach for first."""

import re
import shutil
import subprocess
from collections.abc import Iterator

import foreign
import pytest
from serial_peers import BAUD, OurServer, our_server

TABLE_OF = {"0": "coils", "1": "discrete_inputs", "3": "input_registers", "4": "holding_registers"}


@pytest.fixture(scope="module")
def server() -> Iterator[OurServer]:
    with our_server("rtu") as server:
        yield server


def mbpoll(path: str, *words: str) -> subprocess.CompletedProcess[str]:
    """One poll of unit 1 with 0-based addresses; words that begin with = are values to write."""
    program = shutil.which("mbpoll")
    if program is None:
        foreign.missing("no mbpoll (Debian: mbpoll)")
    options = [word for word in words if not word.startswith("=")]
    values = [word.removeprefix("=") for word in words if word.startswith("=")]
    line = ["-m", "rtu", "-b", str(BAUD), "-P", "none", "-d", "8", "-s", "2", "-a", "1"]
    return subprocess.run(
        [program, *line, "-0", "-1", "-o", "5", *options, path, *values],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=foreign.LIMIT,
        check=False,
    )


def values_in(output: str) -> list[float]:
    """The numbers of the lines ``[address]: value``; a negative 16-bit number stands in brackets behind its bits."""
    return [float(found) for found in re.findall(r"^\[\d+\]:\s+(-?[\d.]+)", output, re.MULTILINE)]


@pytest.mark.parametrize("type_number", TABLE_OF)
@pytest.mark.parametrize(("address", "count"), [(0, 1), (7, 10), (100, 125)])
def test_reading_a_table_gives_its_content(server: OurServer, type_number: str, address: int, count: int) -> None:
    finished = mbpoll(server.path, "-t", type_number, "-r", str(address), "-c", str(count))
    assert finished.returncode == 0, finished.stderr
    assert values_in(finished.stdout) == foreign.CONTENT[TABLE_OF[type_number]][address : address + count]


@pytest.mark.parametrize(
    ("type_number", "address", "values"),
    [("0", 600, [1]), ("0", 610, [1, 0, 1, 1, 0]), ("4", 600, [1234]), ("4", 610, [1, 2, 3, 40000])],
)
def test_what_was_written_is_in_the_device(
    server: OurServer, type_number: str, address: int, values: list[int]
) -> None:
    written = mbpoll(server.path, "-t", type_number, "-r", str(address), *(f"={value}" for value in values))
    assert written.returncode == 0, written.stderr
    assert f"Written {len(values)} references." in written.stdout
    table = getattr(server.device, TABLE_OF[type_number])
    assert list(table[address : address + len(values)]) == values


def test_the_server_tells_its_id(server: OurServer) -> None:
    finished = mbpoll(server.path, "-u")
    assert finished.returncode == 0, finished.stderr + finished.stdout
    assert "Status: On" in finished.stdout


def test_an_address_beyond_the_table_is_refused(server: OurServer) -> None:
    finished = mbpoll(server.path, "-t", "4", "-r", "999", "-c", "2")
    assert finished.returncode != 0
    assert "Illegal data address" in finished.stderr + finished.stdout
