"""A serial line: how close reads come to what its characters and silences allow.

Reads of 10 registers (100, if there is time) by RTU, 8E1, from one server of ours, on a paced line. Line, server
and client are processes of their own. The line has one core; the other two are never busy at the same time and share
the other one. All have real-time priority where that is allowed, so that what else the machine does is not measured.

The least that a read can take is its 8 + 25 characters and two silences of t3.5, one before the request and one before
the reply; the server gets no time of its own on top. The table shows the silences as the line saw them. A client whose
silence is shorter than t3.5 gains time that the specification does not give.

`seconds` is the time of all reads in the quietest round, `typical` that of so many median reads. They differ by the
moments in which the machine did something else: a stall of 3 ms is half a read at 115 200 baud. The bars take the
typical one.
"""

import statistics
from collections.abc import Callable
from dataclasses import dataclass, field
from signal import SIGUSR1, SIGUSR2

from harness import children
from harness.bench import Bench, Command
from harness.children import ChildFailed
from harness.report import Bar, Table

READS, LEAST_READS = 100, 12
STARTING = 1.0
"""Seconds that line, server and client of one turn take to start."""
REGISTERS = 10
CHARACTERS = 8 + 5 + 2 * REGISTERS
CHARACTER_BITS = 11
RATES = (9_600, 19_200, 115_200)

AWAIT, BLOCKING = "busway, await", "busway, blocking"
PRECISE = ", precise_timing"
COLUMNS = (
    "",
    "at least s",
    "seconds",
    "excess %",
    "typical s",
    "excess %",
    "before reply ms",
    "before request ms",
    "t3.5 ms",
    "CPU ms each",
)


@dataclass(slots=True)
class Contender:
    """A client, the server it asks, and what its rounds took."""

    client: Callable[[str, int], Command]
    server_options: str = ""
    seconds: list[float] = field(default_factory=list)
    typical: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    replies: list[float] = field(default_factory=list)
    requests: list[float] = field(default_factory=list)
    missing: str = ""


def run(bench: Bench) -> Table:
    reads = _reads(bench)
    table = Table(f"A serial line: {reads} x FC03 x {REGISTERS} registers, RTU 8E1", COLUMNS)
    excess: dict[tuple[int, str], float | None] = {}
    for baud in RATES:
        contenders = _contenders(bench, baud, reads)
        for number in range(bench.rounds):
            for name, contender in contenders.items():
                _measure(bench, baud, reads, name, contender, number)
        for name, contender in contenders.items():
            excess[baud, name] = _add(table, baud, reads, name, contender)
    table.bars = [
        Bar(f"{baud} baud: {name}, typical read above the least", excess.get((baud, name)), "<=", limit, "%")
        for baud, name, limit in _limits()
    ]
    return table


def _reads(bench: Bench) -> int:
    """So many reads of each contender as the budget allows."""
    contenders = {baud: len(_contenders(bench, baud, 0)) for baud in RATES}
    left = bench.budget / bench.rounds - STARTING * sum(contenders.values())
    return min(max(int(left / sum(count * least(baud) for baud, count in contenders.items())), LEAST_READS), READS)


def _limits() -> list[tuple[int, str, float]]:
    usual = [(baud, name, 10.0 if baud == 115_200 else 5.0) for baud in RATES for name in (AWAIT, BLOCKING)]
    return [*usual, *((115_200, name + PRECISE, 5.0) for name in (AWAIT, BLOCKING))]


def _t3_5(baud: int) -> float:
    return 0.00175 if baud > 19_200 else 3.5 * CHARACTER_BITS / baud


def least(baud: int) -> float:
    """Seconds that one read takes at least."""
    return CHARACTERS * CHARACTER_BITS / baud + 2 * _t3_5(baud)


def _contenders(bench: Bench, baud: int, reads: int) -> dict[str, Contender]:
    def ours(kind: str, options: str = "") -> Contender:
        def client(path: str, baud: int) -> Command:
            url = f"rtu://{path}?baud={baud}{options}"
            return bench.ours("clients.busway_line", kind, url, reads, REGISTERS)

        return Contender(client, options)

    def peer(module: str, *words: str) -> Contender:
        return Contender(lambda path, baud: bench.peer(f"peers.{module}", *words, path, baud, reads, REGISTERS))

    contenders = {
        "minimalmodbus": peer("minimalmodbus_line_client"),
        "pymodbus, blocking": peer("pymodbus_line_client", "blocking"),
        "pymodbus, await": peer("pymodbus_line_client", "await"),
        BLOCKING: ours("blocking"),
        AWAIT: ours("await"),
    }
    if baud == 115_200:
        contenders[BLOCKING + PRECISE] = ours("blocking", "&precise_timing=on")
        contenders[AWAIT + PRECISE] = ours("await", "&precise_timing=on")
    return contenders


def _measure(bench: Bench, baud: int, reads: int, name: str, contender: Contender, number: int) -> None:
    if contender.missing:
        return
    try:
        with children.server(bench.ours("servers.paced_line", baud), bench.server_core, "line") as line:
            master, serving = line.told
            url = f"rtu://{serving}?baud={baud}{contender.server_options}"
            with children.server(bench.ours("servers.busway_line_server", url), bench.load_core, "serving"):
                command = contender.client(master, baud)
                line.answer(SIGUSR1, "forgotten")
                result = children.run(command, bench.load_core, reads * least(baud) * 3)
                before_reply, before_request, _ = map(float, line.answer(SIGUSR2, "silences"))
    except ChildFailed as failure:
        contender.missing = str(failure)
        bench.say(f"{baud} baud, {name} is left out: {failure}")
        return
    contender.seconds.append(result["seconds"])
    contender.typical.append(result["typical"])
    contender.cpu.append(result["cpu"] / reads)
    contender.replies.append(before_reply)
    contender.requests.append(before_request)
    bench.say(f"round {number + 1}  {baud:>6} baud  {name:<34} {result['seconds']:.3f} s, {result['typical']:.3f} s")


def _add(table: Table, baud: int, reads: int, name: str, contender: Contender) -> float | None:
    """Add a row; gives the excess of the typical read in per cent."""
    label = f"{baud:>6} baud  {name}"
    if contender.missing or not contender.seconds:
        table.rows.append((label, "–", *[""] * (len(COLUMNS) - 2)))
        table.figures.append({"baud": baud, "name": name, "missing": contender.missing})
        return None
    whole = reads * least(baud)
    seconds, typical = min(contender.seconds), statistics.median(contender.typical)
    excess, typical_excess = (seconds / whole - 1) * 100, (typical / whole - 1) * 100
    before_reply, before_request = (statistics.median(one) for one in (contender.replies, contender.requests))
    table.rows.append(
        (
            label,
            f"{whole:.3f}",
            f"{seconds:.3f}",
            f"{excess:.1f}",
            f"{typical:.3f}",
            f"{typical_excess:.1f}",
            f"{before_reply * 1e3:.2f}",
            f"{before_request * 1e3:.2f}",
            f"{_t3_5(baud) * 1e3:.2f}",
            f"{statistics.median(contender.cpu) * 1e3:.2f}",
        )
    )
    table.figures.append(
        {
            "baud": baud,
            "name": name,
            "least": whole,
            "excess_percent": excess,
            "typical_excess_percent": typical_excess,
            "rounds": contender.seconds,
            "typical": contender.typical,
            "before_reply": before_reply,
            "before_request": before_request,
            "cpu": statistics.median(contender.cpu),
        }
    )
    return typical_excess
