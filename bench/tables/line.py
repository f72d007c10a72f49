"""A serial line: how close reads come to what its characters and silences allow.

Reads of 10 registers by RTU, 8E1, from one server of ours, on a paced line. Lines, servers and clients are processes of
their own. The lines have one core; server and client are never busy at the same time and share the other one. All have
real-time priority where that is allowed, so that what else the machine does is not measured.

All programs stay, and take short turns (`harness.turns`): in every round each client opens its port, makes a handful of
reads and closes it again. A noisy moment spoils some turns of all instead of all turns of one.

The least that a read can take is its 8 + 25 characters and two silences of t3.5, one before the request and one before
the reply; the server gets no time of its own on top. The table shows the silences as the line saw them. A client whose
silence is shorter than t3.5 gains time that the specification does not give.

`typical` is the middle read of the middle turn, `mean` is that of all reads of the quietest quarter of turns. They
differ by the moments in which the machine did something else: a stall of 3 ms is half a read at 115 200 baud. The bars
take the typical one.
"""

import statistics
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from signal import SIGUSR1, SIGUSR2

from harness import children
from harness.bench import Bench, Command
from harness.children import ChildFailed, Server
from harness.report import Bar, Table
from harness.turns import Contender

READS = 8
"""Of one turn; one more opens the port."""
STARTING = 0.4
"""Seconds that one program takes to start, on a busy machine."""
OPENING = 0.07
"""Seconds of a turn that go into opening and closing its port, and into asking how quick the line's ports are."""
LEAST_TURNS, MOST_TURNS = 3, 20
"""Of a contender: in all, and for each round that the run has; between them the budget decides."""
REGISTERS = 10
CHARACTERS = 8 + 5 + 2 * REGISTERS
CHARACTER_BITS = 11
RATES = (9_600, 19_200, 115_200)

AWAIT, BLOCKING = "busway, await", "busway, blocking"
PRECISE = ", precise_timing"
PRECISELY = "&precise_timing=on"
COLUMNS = (
    "",
    "at least ms",
    "mean ms",
    "excess %",
    "typical ms",
    "± %",
    "excess %",
    "before reply ms",
    "before request ms",
    "t3.5 ms",
    "CPU ms each",
)


@dataclass(slots=True)
class Master:
    """A client on a line, and the silences that the line saw."""

    baud: int
    name: str
    command: Callable[[str], Command]
    server_options: str = ""
    contender: Contender = field(default_factory=Contender)
    replies: list[float] = field(default_factory=list)
    requests: list[float] = field(default_factory=list)


def run(bench: Bench) -> Table:
    masters = _masters(bench)
    rounds = _rounds(bench, masters)
    table = Table(f"A serial line: FC03 x {REGISTERS} registers, RTU 8E1", COLUMNS)
    with ExitStack() as running:
        line = _start(bench, running, masters)
        for number in range(rounds):
            for master in masters:
                _turn(bench, line, master, number)
            bench.say(f"line: round {number + 1} of {rounds}")
    excess = {(master.baud, master.name): _add(table, master) for master in masters}
    table.notes = [f"{rounds} rounds of {READS} reads each; ±: half the distance of the quartiles of the rounds"]
    table.bars = [
        Bar(f"{baud} baud: {name}, typical read above the least", excess.get((baud, name)), "<=", limit, "%")
        for baud, name, limit in _limits()
    ]
    return table


def _rounds(bench: Bench, masters: list[Master]) -> int:
    """Short ones, as many as the budget allows."""
    one = sum((READS + 1) * least(master.baud) * 1.05 + OPENING for master in masters)
    left = bench.budget - STARTING * (len(masters) + 5)
    return min(max(int(left / one), LEAST_TURNS), MOST_TURNS * bench.rounds)


def _limits() -> list[tuple[int, str, float]]:
    usual = [(baud, name, 10.0 if baud == 115_200 else 5.0) for baud in RATES for name in (AWAIT, BLOCKING)]
    return [*usual, *((115_200, name + PRECISE, 5.0) for name in (AWAIT, BLOCKING))]


def _t3_5(baud: int) -> float:
    return 0.00175 if baud > 19_200 else 3.5 * CHARACTER_BITS / baud


def least(baud: int) -> float:
    """Seconds that one read takes at least."""
    return CHARACTERS * CHARACTER_BITS / baud + 2 * _t3_5(baud)


def _masters(bench: Bench) -> list[Master]:
    def ours(baud: int, name: str, kind: str, options: str = "") -> Master:
        def command(path: str) -> Command:
            return bench.ours("clients.busway_line", kind, f"rtu://{path}?baud={baud}{options}", READS, REGISTERS)

        return Master(baud, name, command, options)

    def peer(baud: int, name: str, module: str, *words: str) -> Master:
        def command(path: str) -> Command:
            return bench.peer(f"peers.{module}", *words, path, baud, READS, REGISTERS)

        return Master(baud, name, command)

    masters = []
    for baud in RATES:
        masters += [
            peer(baud, "minimalmodbus", "minimalmodbus_line_client"),
            peer(baud, "pymodbus, blocking", "pymodbus_line_client", "blocking"),
            peer(baud, "pymodbus, await", "pymodbus_line_client", "await"),
            ours(baud, BLOCKING, "blocking"),
            ours(baud, AWAIT, "await"),
        ]
    return [
        *masters,
        ours(115_200, BLOCKING + PRECISE, "blocking", PRECISELY),
        ours(115_200, AWAIT + PRECISE, "await", PRECISELY),
    ]


def _start(bench: Bench, running: ExitStack, masters: list[Master]) -> Server:
    """Start lines, servers and masters; gives the process of the lines."""
    kinds = sorted({(master.baud, master.server_options) for master in masters})
    lines = bench.ours("servers.paced_line", *(baud for baud, _ in kinds))
    line = running.enter_context(children.server(lines, bench.server_core, "line"))
    paths: dict[tuple[int, str], str] = {}
    for (baud, options), path, serving in zip(kinds, line.told[::2], line.told[1::2], strict=True):
        command = bench.ours("servers.busway_line_server", f"rtu://{serving}?baud={baud}{options}")
        running.enter_context(children.server(command, bench.load_core, "serving"))
        paths[baud, options] = path
    for master in masters:
        contender = master.contender
        try:
            command = master.command(paths[master.baud, master.server_options])
            contender.program = running.enter_context(children.server(command, bench.load_core, "ready"))
        except ChildFailed as failure:
            contender.missing = str(failure)
            bench.say(f"{master.baud} baud, {master.name} is left out: {failure}")
    return line


def _turn(bench: Bench, line: Server, master: Master, number: int) -> None:
    if master.contender.missing:
        return
    line.answer(SIGUSR1, "forgotten")
    failure = master.contender.turn(number)
    if failure:
        bench.say(f"{master.baud} baud, {master.name}, a turn failed: {failure}")
        return
    before_reply, before_request, _ = map(float, line.answer(SIGUSR2, "silences"))
    master.replies.append(before_reply)
    master.requests.append(before_request)


def _add(table: Table, master: Master) -> float | None:
    """Add a row; gives the excess of the typical read in per cent."""
    contender = master.contender
    label = f"{master.baud:>6} baud  {master.name}"
    typical = contender.typical
    if contender.missing or typical is None:
        table.rows.append((label, "–", *[""] * (len(COLUMNS) - 2)))
        table.figures.append({"baud": master.baud, "name": master.name, "missing": contender.missing})
        return None
    whole = least(master.baud)
    means = sorted(contender.values(lambda took: took.seconds / took.reads))
    mean = statistics.fmean(means[: max(len(means) // 4, 1)])
    excess, typical_excess = (mean / whole - 1) * 100, (typical / whole - 1) * 100
    before_reply, before_request = statistics.median(master.replies), statistics.median(master.requests)
    table.rows.append(
        (
            label,
            f"{whole * 1e3:.3f}",
            f"{mean * 1e3:.3f}",
            f"{excess:.1f}",
            f"{typical * 1e3:.3f}",
            f"{contender.swing:.1f}",
            f"{typical_excess:.1f}",
            f"{before_reply * 1e3:.2f}",
            f"{before_request * 1e3:.2f}",
            f"{_t3_5(master.baud) * 1e3:.2f}",
            f"{contender.cpu * 1e3:.2f}",
        )
    )
    table.figures.append(
        {
            "baud": master.baud,
            "name": master.name,
            "least": whole,
            "excess_percent": excess,
            "typical_excess_percent": typical_excess,
            "typical": contender.values(lambda took: took.typical),
            "mean": contender.values(lambda took: took.seconds / took.reads),
            "failed_turns": contender.failed,
            "before_reply": before_reply,
            "before_request": before_request,
            "cpu": contender.cpu,
        }
    )
    return typical_excess
