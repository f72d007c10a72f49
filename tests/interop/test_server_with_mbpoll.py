"""Our server against mbpoll, the command that people reach for first."""

import re
import shutil
import subprocess

import foreign
import pytest

TABLE_OF = {"0": "coils", "1": "discrete_inputs", "3": "input_registers", "4": "holding_registers"}


def mbpoll(port: int, *words: str) -> subprocess.CompletedProcess[str]:
    """One poll with 0-based addresses; words before the host are options, those after it values to write."""
    program = shutil.which("mbpoll")
    if program is None:
        foreign.missing("no mbpoll (Debian: mbpoll)")
    options = [word for word in words if not word.startswith("=")]
    values = [word.removeprefix("=") for word in words if word.startswith("=")]
    command = [program, "-m", "tcp", "-p", str(port), "-a", "1", "-0", "-1", "-o", "5", *options, "127.0.0.1", *values]
    return subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=foreign.LIMIT, check=False
    )


def values_in(output: str) -> list[float]:
    """The numbers of the lines ``[address]: value``; a negative 16-bit number stands in brackets behind its bits."""
    return [float(found) for found in re.findall(r"^\[\d+\]:\s+(-?[\d.]+)", output, re.MULTILINE)]


@pytest.mark.parametrize("type_number", TABLE_OF)
@pytest.mark.parametrize(("address", "count"), [(0, 1), (7, 10), (100, 125)])
def test_reading_a_table_gives_its_content(our_port: int, type_number: str, address: int, count: int) -> None:
    finished = mbpoll(our_port, "-t", type_number, "-r", str(address), "-c", str(count))
    assert finished.returncode == 0, finished.stderr
    assert values_in(finished.stdout) == foreign.CONTENT[TABLE_OF[type_number]][address : address + count]


@pytest.mark.parametrize(
    ("type_number", "address", "values"),
    [("0", 600, [1]), ("0", 610, [1, 0, 1, 1, 0]), ("4", 600, [1234]), ("4", 610, [1, 2, 3, 40000])],
)
def test_what_was_written_is_read(our_port: int, type_number: str, address: int, values: list[int]) -> None:
    written = mbpoll(our_port, "-t", type_number, "-r", str(address), *(f"={value}" for value in values))
    assert written.returncode == 0, written.stderr
    assert f"Written {len(values)} references." in written.stdout
    finished = mbpoll(our_port, "-t", type_number, "-r", str(address), "-c", str(len(values)))
    assert values_in(finished.stdout) == values


def test_a_float_survives_in_big_endian_word_order(our_port: int) -> None:
    assert mbpoll(our_port, "-t", "4:float", "-B", "-r", "620", "=1.5").returncode == 0
    assert values_in(mbpoll(our_port, "-t", "4:float", "-B", "-r", "620").stdout) == [1.5]
    assert values_in(mbpoll(our_port, "-t", "4:hex", "-r", "620", "-c", "2").stdout.replace("0x", "")) == [3, 0]


def test_an_address_beyond_the_table_is_refused(our_port: int) -> None:
    finished = mbpoll(our_port, "-t", "4", "-r", "999", "-c", "2")
    assert finished.returncode != 0
    assert "Illegal data address" in finished.stderr + finished.stdout
