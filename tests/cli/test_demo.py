"""`busway demo`: as a process of its own, where output is no terminal."""

import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import pytest

from busway.cli.demo import percentile

PROGRAM = [sys.executable, "-m", "busway"]


def test_it_prints_a_block_a_second_and_ends_with_a_summary_and_three_commands() -> None:
    ended = subprocess.run(
        [*PROGRAM, "demo", "--for", "2.2", "--port", "0"], capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == 0
    assert ended.stderr == ""
    lines = ended.stdout.splitlines()
    headings = [line for line in lines if line.startswith("tcp://")]
    seconds = [int(found) for heading in headings for found in re.findall(r"  (\d+) s  ", heading)]
    assert seconds[0] >= 1
    assert seconds == sorted(set(seconds))
    for tag in ("1  tank.level", "1  pump.running", "2  meter.flow", "3  tank.temperature"):
        assert sum(tag in line for line in lines) == len(headings)
    (summary,) = [line for line in lines if "latency" in line]
    assert re.fullmatch(
        r"\d+ transactions?, \d+ errors? in \d+\.\d s; latency p50 \S+ ms, p95 \S+ ms, p99 \S+ ms", summary
    )
    assert len([line for line in lines if line.startswith("  busway ")]) == 3


@pytest.mark.real_time
def test_a_device_dies_and_comes_back_while_the_others_are_answered() -> None:
    ended = subprocess.run(
        [*PROGRAM, "demo", "--for", "9.5", "--port", "0"], capture_output=True, text=True, timeout=60, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    rows = [line.split() for line in ended.stdout.splitlines() if line.startswith("  ") and "tank." in line]
    level, temperature = ([row[2] for row in rows if row[1] == tag] for tag in ("tank.level", "tank.temperature"))
    dead = [number for number, value in enumerate(temperature) if value == "—"]
    assert 0 < dead[0] <= dead[-1] < len(temperature) - 1, temperature
    assert any(level[number] != "—" for number in dead), level


def answered(command: str) -> subprocess.CompletedProcess[str]:
    """What a command says in the end. A device of the demo is slow, one fails now and then: a read may be refused."""
    limit = time.monotonic() + 60
    while True:
        words = [*PROGRAM, *shlex.split(command)[1:]]
        ended = subprocess.run(words, capture_output=True, text=True, timeout=30, check=False)
        if ended.returncode != 3 or time.monotonic() > limit:
            return ended


def test_the_three_commands_work_while_it_runs_for_ever() -> None:
    process = subprocess.Popen(
        [*PROGRAM, "demo", "--forever", "--port", "0"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    with process:
        try:
            commands: list[str] = []
            while len(commands) < 3:
                line = process.stdout.readline()
                assert line
                if line.startswith("  busway "):
                    commands.append(line.strip().removesuffix(" --watch 1s"))
            for command in commands:
                ended = answered(command)
                assert (ended.returncode, ended.stderr) == (0, "")
                assert ended.stdout
            process.send_signal(signal.SIGINT)
            rest, said = process.communicate(timeout=60)
            assert process.returncode == 0
            assert said == ""
            assert "latency" in rest
        finally:
            process.kill()


def test_a_port_that_is_taken_is_replaced_and_that_is_said_in_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = holder.getsockname()[1]
        ended = subprocess.run(
            [*PROGRAM, "demo", "--for", "0.3", "--port", str(port)],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    assert ended.returncode == 0
    (sentence,) = ended.stderr.splitlines()
    assert re.fullmatch(rf"busway: port {port} is taken; the gateway is on tcp://127\.0\.0\.1:\d+", sentence)
    assert f":{port} " not in ended.stdout


@pytest.mark.parametrize(("arguments", "name"), [(["--for", "x"], "--for"), (["--port", "65536"], "--port")])
def test_a_bad_option_is_named(run: Callable[..., Any], arguments: list[str], name: str) -> None:
    result = run("demo", *arguments)
    assert (result.code, result.out) == (2, "")
    assert name in result.err


@pytest.mark.parametrize(
    ("values", "percent", "expected"),
    [([], 50, 0.0), ([1.0], 99, 1.0), ([1.0, 2.0, 3.0, 4.0], 50, 2.0), ([float(n) for n in range(1, 101)], 95, 95.0)],
)
def test_a_percentile_is_the_value_that_so_many_do_not_exceed(
    values: list[float], percent: float, expected: float
) -> None:
    assert percentile(values, percent) == expected
