"""What masters of a serial line make of late replies: right values, values of other requests, errors, time.

    python bench/late_replies.py                                    every master that is here, 500 reads each
    python bench/late_replies.py --reads 100 --only busway,pymodbus --timeout 0.5
    python bench/late_replies.py --markdown                         the table of docs/serial.md

The slave is a device with a queue, as a converter or a slow meter has one: it takes every request it gets, works on one
after the other (30 ms each), and answers all of them in order, also those that the master has given up. Some of the
answers (2 %) are late by 1.3 s. Every master reads two registers at alternating addresses and gives a reply one second.

Knows the bytes of reads over RTU, and how each master is called; knows nothing of the inside of a master.

1. A value is *right* if it is that of the address asked, and was read for a request sent during the call. It is *wrong*
   if the master gave it to its caller and it is neither. Anything else is an *error*.
2. The slave says which: the first register of a reply is the address asked, the second counts its requests.
3. Which answers are late depends on the count of the request alone, so that all masters meet the same.
4. Masters run in a process each: those of `.peers` in its Python, libmodbus as a C program (bench/c/late_reads.c).
"""

import argparse
import asyncio
import contextlib
import json
import os
import random
import select
import shutil
import subprocess
import sys
import tempfile
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

BENCH = Path(__file__).resolve().parent
PEER_PYTHON = BENCH.parent / ".peers" / "bin" / "python"
C_SOURCE = BENCH / "c" / "late_reads.c"

UNIT = 1
ADDRESSES = 10
"""Addresses that are read in turn."""
BAUD = 19200
SERVICE = 0.03
LATE_PART = 0.02
LATE_BY = 1.3
SEED = 20
START_LIMIT = 30.0
"""Seconds for a master or the slave to start on a busy machine."""


# The slave.


@dataclass
class Queue:
    """When the device answers: one request after the other, some of the answers late."""

    service: float
    late_part: float
    late_by: float
    chance: random.Random
    free_at: float = 0.0

    def leaves(self, arrived: float) -> float:
        """When the answer to a request leaves that arrived so."""
        self.free_at = max(self.free_at, arrived) + self.service
        if self.chance.random() < self.late_part:
            self.free_at += self.late_by
        return self.free_at


def crc(data: bytes) -> bytes:
    """The CRC of RTU, as it is sent."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return value.to_bytes(2, "little")


def requests_in(heard: bytearray) -> Iterator[bytes]:
    """The frames of requests at the beginning of what was heard, taken out of it. All that are sent here are short."""
    while len(heard) >= 4:
        size = next(
            (end for end in range(4, min(len(heard), 64) + 1) if crc(heard[: end - 2]) == heard[end - 2 : end]), 0
        )
        if not size:
            if len(heard) < 64:
                return
            size = 1
        frame = bytes(heard[:size])
        del heard[:size]
        if size > 1:
            yield frame


def answer(frame: bytes, count: int) -> bytes:
    """What the device answers: to a read of registers the address and the count, to anything else exception 01."""
    unit, function = frame[0], frame[1]
    if function in (3, 4) and len(frame) == 8:
        address, registers = int.from_bytes(frame[2:4], "big"), int.from_bytes(frame[4:6], "big")
        values = [address, count & 0xFFFF, *[0] * registers][:registers]
        pdu = bytes((unit, function, 2 * registers)) + b"".join(value.to_bytes(2, "big") for value in values)
    else:
        pdu = bytes((unit, function | 0x80, 1))
    return pdu + crc(pdu)


def play_slave(queue: Queue) -> None:
    """Serve a pseudo-terminal until standard input ends; print its path, and at the end the times of the requests."""
    master, slave = os.openpty()  # the slave's end stays open, or the master's reports an error while no process has it
    tty.setraw(slave)
    print(json.dumps(os.ttyname(slave)), flush=True)
    heard = bytearray()
    arrived: list[float] = []
    due: list[tuple[float, bytes]] = []
    while True:
        pause = max(due[0][0] - time.monotonic(), 0.0) if due else None
        ready, _, _ = select.select([master, sys.stdin], [], [], pause)
        if sys.stdin in ready:
            break
        now = time.monotonic()
        if master in ready:
            heard += os.read(master, 4096)
            for frame in requests_in(heard):
                if frame[0] == UNIT:
                    due.append((queue.leaves(now), answer(frame, len(arrived))))
                    arrived.append(now)
        while due and due[0][0] <= time.monotonic():
            os.write(master, due.pop(0)[1])
    print(json.dumps(arrived), flush=True)


# The masters: each makes reads and prints a line for each of them.

Read = Callable[[int], list[int]]


def make_reads(read: Read, reads: int) -> None:
    """Print when each read began and ended, its address, its values or None, and what went wrong."""
    for number in range(reads):
        address = number % ADDRESSES
        began = time.monotonic()
        values, problem = None, ""
        try:
            values = list(read(address))
        except Exception as error:  # whatever a master raises is an error to its caller
            problem = f"{type(error).__name__}: {error}"
        print(json.dumps([began, time.monotonic(), address, values, problem]))


def with_busway(path: str, reads: int, timeout: float) -> None:
    import busway

    with busway.connect(f"rtu://{path}?baud={BAUD}&parity=none&timeout={timeout}") as link:
        unit = link.unit(UNIT)
        make_reads(lambda address: unit.read_holding_registers(address, count=2), reads)


def with_busway_asyncio(path: str, reads: int, timeout: float) -> None:
    import busway

    async def run() -> None:
        async with busway.open(f"rtu://{path}?baud={BAUD}&parity=none&timeout={timeout}") as link:
            unit = link.unit(UNIT)
            for number in range(reads):
                address, began = number % ADDRESSES, time.monotonic()
                values, problem = None, ""
                try:
                    values = list(await unit.read_holding_registers(address, count=2))
                except busway.BuswayError as error:
                    problem = f"{type(error).__name__}: {error}"
                print(json.dumps([began, time.monotonic(), address, values, problem]))

    asyncio.run(run())


def with_pymodbus(path: str, reads: int, timeout: float) -> None:
    from pymodbus.client import ModbusSerialClient  # type: ignore[import-not-found]

    client = ModbusSerialClient(path, baudrate=BAUD, timeout=timeout)
    client.connect()

    def read(address: int) -> list[int]:
        reply = client.read_holding_registers(address, count=2, device_id=UNIT)
        if reply.isError():
            raise OSError(str(reply))
        return list(reply.registers)

    make_reads(read, reads)
    client.close()


def with_minimalmodbus(path: str, reads: int, timeout: float) -> None:
    import minimalmodbus  # type: ignore[import-not-found]

    instrument = minimalmodbus.Instrument(path, UNIT)
    instrument.serial.baudrate = BAUD
    instrument.serial.timeout = timeout
    make_reads(lambda address: instrument.read_registers(address, 2), reads)
    instrument.serial.close()


MASTERS: dict[str, Callable[[str, int, float], None] | None] = {
    "busway": with_busway,
    "busway asyncio": with_busway_asyncio,
    "pymodbus": with_pymodbus,
    "minimalmodbus": with_minimalmodbus,
    "libmodbus": None,
}


def command_of(master: str, path: str, reads: int, timeout: float, folder: Path) -> list[str] | str:
    """How a master is started, or why it cannot be started."""
    arguments = [path, str(reads), str(timeout)]
    if master == "libmodbus":
        program = compiled(folder)
        return program if program.startswith("left out") else [program, *arguments]
    if master.startswith("busway"):
        return [sys.executable, __file__, "--master", master, *arguments]
    if not PEER_PYTHON.exists():
        return "left out: no .peers (make peers)"
    return [str(PEER_PYTHON), __file__, "--master", master, *arguments]


def compiled(folder: Path) -> str:
    """The path of the C program; or why there is none."""
    compiler, finder = shutil.which("cc"), shutil.which("pkg-config")
    if compiler is None or finder is None:
        return "left out: no C compiler or no pkg-config"
    flags = subprocess.run([finder, "--cflags", "--libs", "libmodbus"], capture_output=True, text=True, check=False)
    if flags.returncode:
        return "left out: no libmodbus (Debian: libmodbus-dev)"
    program = folder / "late_reads"
    command = [compiler, "-Wall", "-Wextra", "-O1", "-o", str(program), str(C_SOURCE), *flags.stdout.split()]
    subprocess.run(command, check=True)
    return str(program)


# The comparison.


@dataclass(frozen=True)
class Result:
    """What one master made of it."""

    master: str
    right: int
    wrong: int
    errors: int
    seconds: float
    first_error: str = ""
    left_out: str = ""


def judged(master: str, lines: list[Any], arrived: list[float]) -> Result:
    """Count the reads of a master; ``arrived`` says when each request reached the slave."""
    right = wrong = errors = 0
    first_error = ""
    for began, _, address, values, problem in lines:
        if values is None:
            errors += 1
            first_error = first_error or problem
            continue
        # The count is 16 bits wide, and a run is shorter than that.
        is_right = len(values) == 2 and values[0] == address and values[1] < len(arrived)
        if is_right and arrived[values[1]] >= began:
            right += 1
        else:
            wrong += 1
    return Result(master, right, wrong, errors, lines[-1][1] - lines[0][0] if lines else 0.0, first_error)


def run(master: str, options: argparse.Namespace, folder: Path) -> Result:
    """One master against a slave of its own."""
    device = [sys.executable, __file__, "--slave", str(options.late), str(options.late_by), str(options.service)]
    with subprocess.Popen(device, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as slave:
        assert slave.stdin is not None
        assert slave.stdout is not None
        try:
            path = json.loads(slave.stdout.readline())
            command = command_of(master, path, options.reads, options.timeout, folder)
            if isinstance(command, str):
                return Result(master, 0, 0, 0, 0.0, left_out=command)
            # At the worst every read fails, with a few attempts each.
            limit = START_LIMIT + options.reads * 6 * (options.timeout + options.late_by * options.late + 0.1)
            done = subprocess.run(command, capture_output=True, text=True, timeout=limit, check=False)
            if done.returncode:
                return Result(master, 0, 0, 0, 0.0, left_out=f"left out: {done.stderr.strip().splitlines()[-1]}")
            slave.stdin.close()
            arrived = json.loads(slave.stdout.readline())
        finally:
            slave.kill()
    return judged(master, [json.loads(line) for line in done.stdout.splitlines()], arrived)


def version_of(master: str) -> str:
    """The name of a master with its version, as far as it is known."""
    if master == "libmodbus":
        found = subprocess.run(["pkg-config", "--modversion", "libmodbus"], capture_output=True, text=True, check=False)
        return f"{master} {found.stdout.strip()}"
    if master.startswith("busway"):
        return master
    code = f"import importlib.metadata as m; print(m.version('{master}'))"
    found = subprocess.run([PEER_PYTHON, "-c", code], capture_output=True, text=True, check=False)
    return f"{master} {found.stdout.strip()}"


def shown(results: list[Result], *, markdown: bool) -> str:
    """The table."""
    rows = [["master", "right", "wrong", "errors", "seconds"]]
    for one in results:
        if one.left_out:
            rows.append([one.master, one.left_out, "", "", ""])
        else:
            rows.append([version_of(one.master), *map(str, (one.right, one.wrong, one.errors, round(one.seconds)))])
    if markdown:
        rows.insert(1, ["---"] * 5)
        return "\n".join("| " + " | ".join(row) + " |" for row in rows)
    return "\n".join(f"{row[0]:24}" + "".join(f"{cell:>9}" for cell in row[1:]) for row in rows)


def parsed(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    says = __doc__ or ""
    parser = argparse.ArgumentParser(description=says, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reads", type=int, default=500, help="reads of each master (500)")
    parser.add_argument("--timeout", type=float, default=1.0, help="seconds that a master gives a reply (1)")
    parser.add_argument("--late", type=float, default=LATE_PART, help="part of the answers that are late (0.02)")
    parser.add_argument("--late-by", type=float, default=LATE_BY, help="their delay in seconds (1.3)")
    parser.add_argument("--service", type=float, default=SERVICE, help="seconds of work on each request (0.03)")
    parser.add_argument("--only", default=",".join(MASTERS), help="masters, separated by commas")
    parser.add_argument("--markdown", action="store_true", help="print the table for a page")
    parser.add_argument("--json", action="store_true", help="print a line of JSON for each master")
    options = parser.parse_args(arguments)
    options.only = options.only.split(",")
    for master in options.only:
        if master not in MASTERS:
            parser.error(f"there is no master {master}; there are {', '.join(MASTERS)}")
    if not 1 <= options.reads <= 10_000:
        parser.error("--reads is 1…10000")
    return options


def main() -> None:
    """Run every master, one after the other, and print the table."""
    options = parsed()
    results = []
    with tempfile.TemporaryDirectory(prefix="late-replies-") as folder:
        for master in options.only:
            results.append(run(master, options, Path(folder)))
            if options.json:
                print(json.dumps(vars(results[-1])), flush=True)
            elif results[-1].first_error:
                print(f"{master}: {results[-1].first_error}", file=sys.stderr)
    if not options.json:
        print(shown(results, markdown=options.markdown))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--slave"]:
        late_part, late_by, service = map(float, sys.argv[2:5])
        with contextlib.suppress(KeyboardInterrupt):
            play_slave(Queue(service, late_part, late_by, random.Random(SEED)))
    elif sys.argv[1:2] == ["--master"]:
        begin = MASTERS[sys.argv[2]]
        assert begin is not None
        begin(sys.argv[3], int(sys.argv[4]), float(sys.argv[5]))
    else:
        main()
