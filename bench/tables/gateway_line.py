"""A gateway from TCP to a serial line: what it adds to a transaction, beside a master that has the line for itself.

Reads of 10 registers over RTU on a paced line, 115 200 baud 8E1, from one server of ours. First our master directly on
the line, lock-step; then a client over TCP through a gateway, lock-step; then two clients, so that one request always
waits when the line becomes free. The floor is what characters and t3.5 take at least. Master and gateways have a line
with a server each, so that all programs can stay and take short turns (`harness.turns`); the lines are alike to the
microsecond. The lines have one core, all others share the other one; all ask for real-time priority where that is
allowed.

`typical` is the middle time from one reply to the next. What a gateway adds is the middle of the ratios to the master's
turn of the same round, a tenth of a second before or after: a noisy minute hits both. Every other round goes backwards.
"""

import shutil
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field

from harness import children
from harness.bench import Bench, Command
from harness.children import ChildFailed
from harness.report import Bar, Table
from harness.turns import Contender

from tables.line import OPENING, REGISTERS, STARTING, least

BAUD = 115_200
READS = 16
"""Of one turn; a gateway's clients share them."""
LEAST_TURNS, MOST_TURNS = 5, 20
"""Of a contender: in all, and for each round that the run has; between them the budget decides."""
PEERS_EVERY = 5
"""Rounds of which the peers take part in one: theirs take four times as long, and swing less."""
PEERS_READ = 5
"""Times the least that a read through a peer is planned to take."""
COLUMNS = ("", "typical ms", "± %", "above the master %", "CPU ms each")
MASTER = "busway as master, on the line"
OURS = "busway gateway"
Way = Callable[[str], Command]
"""A gateway's command for the path of its line."""


@dataclass(slots=True)
class Asker:
    """Clients on a line, or before the gateway that has it (None: no gateway)."""

    gateway: str | None
    clients: int
    contender: Contender = field(default_factory=Contender)

    def takes_part(self, number: int) -> bool:
        """Whether it has a turn in this round."""
        return self.gateway in (None, OURS) or number % PEERS_EVERY == 0


def run(bench: Bench) -> Table:
    ways = _ways(bench)
    askers = {MASTER: Asker(None, 1)}
    for name in ways:
        askers[f"{name}, lock-step"] = Asker(name, 1)
        askers[f"{name}, 2 clients"] = Asker(name, 2)
    rounds = _rounds(bench, len(ways))
    with ExitStack() as running:
        _start(bench, running, ways, askers)
        for number in range(rounds):
            for name in list(askers) if number % 2 == 0 else reversed(askers):
                if askers[name].takes_part(number):
                    _turn(bench, name, askers[name].contender, number)
    table = Table(f"Gateway, TCP to a line: FC03 x {REGISTERS} registers, RTU {BAUD} 8E1", COLUMNS)
    table.rows.append(("floor: characters and silences", f"{least(BAUD) * 1000:.3f}", "", "", ""))
    table.figures.append({"name": "floor", "typical": least(BAUD)})
    master = askers[MASTER].contender
    added = {name: _add(table, name, asker.contender, master) for name, asker in askers.items()}
    table.notes = [
        f"{rounds} rounds of {READS} reads each, peers in every {PEERS_EVERY}th; ±: half the distance of the quartiles",
        "above the master: the middle of the ratios to its turn of the same round",
    ]
    table.bars = [
        Bar(f"{OURS}, lock-step: above the master", added[f"{OURS}, lock-step"], "<=", 5, "%"),
        Bar(f"{OURS}, 2 clients: above the master", added[f"{OURS}, 2 clients"], "<=", 2, "%"),
    ]
    return table


def _ways(bench: Bench) -> dict[str, Way]:
    def ours(path: str) -> Command:
        return bench.ours("servers.busway_gateway", f"rtu://{path}?baud={BAUD}", "--no-sharing", "--real-time")

    ways: dict[str, Way] = {
        OURS: ours,
        "pyModbusTCP gateway": lambda path: bench.peer("peers.tcp2rtu_gateway", path, BAUD),
    }
    mbusd = shutil.which("mbusd")
    if mbusd is None:
        bench.say("mbusd is not on PATH and left out")
    else:
        ways["mbusd"] = lambda path: bench.ours("servers.mbusd", mbusd, path, BAUD)
    return ways


def _rounds(bench: Bench, ways: int) -> int:
    """Short ones, as many as the budget allows."""
    turn = (READS + 2) * least(BAUD) * 1.1
    one = 3 * (turn + OPENING) + (ways - 1) * 2 * (turn * PEERS_READ + OPENING) / PEERS_EVERY
    left = bench.budget - STARTING * (2 + 4 * ways)
    return min(max(int(left / one), LEAST_TURNS), MOST_TURNS * bench.rounds)


def _start(bench: Bench, running: ExitStack, ways: dict[str, Way], askers: dict[str, Asker]) -> None:
    """Start a line, a server and a gateway for each way, and all that ask."""
    lines = bench.ours("servers.paced_line", *[BAUD] * (1 + len(ways)))
    told = running.enter_context(children.server(lines, bench.server_core, "line")).told
    urls: dict[str | None, str] = {}
    for name, path, serving in zip((None, *ways), told[::2], told[1::2], strict=True):
        server = bench.ours("servers.busway_line_server", f"rtu://{serving}?baud={BAUD}")
        running.enter_context(children.server(server, bench.load_core, "serving"))
        if name is None:
            urls[name] = f"rtu://{path}?baud={BAUD}"
            continue
        try:
            gateway = running.enter_context(children.server(ways[name](path), bench.load_core))
            urls[name] = f"tcp://127.0.0.1:{gateway.port}"
        except ChildFailed as failure:
            bench.say(f"gateway_line: {name} is left out: {failure}")
            for asker in askers.values():
                if asker.gateway == name:
                    asker.contender.missing = str(failure)
    for asker in askers.values():
        url = urls.get(asker.gateway)
        if url is not None:
            words = (url, asker.clients, READS // asker.clients + 1, REGISTERS)
            client = bench.ours("clients.busway_lockstep", *words)
            asker.contender.program = running.enter_context(children.server(client, bench.load_core, "ready"))


def _turn(bench: Bench, name: str, contender: Contender, number: int) -> None:
    failure = contender.turn(number)
    if failure:
        bench.say(f"gateway_line: round {number + 1}, {name}: {failure}")
    elif number in contender.turns:
        bench.say(f"gateway_line: round {number + 1:>3}  {name:<34} {contender.turns[number].typical * 1000:.3f} ms")


def _add(table: Table, name: str, contender: Contender, master: Contender) -> float | None:
    """Add a row; gives what is above the master in per cent."""
    typical = contender.typical
    if typical is None or contender.missing:
        table.rows.append((name, "–", "", "", ""))
        table.figures.append({"name": name, "missing": contender.missing})
        return None
    above = None if contender is master else contender.above(master)
    cells = ("" if above is None else f"{above:.1f}", f"{contender.cpu * 1000:.2f}")
    table.rows.append((name, f"{typical * 1000:.3f}", f"{contender.swing:.1f}", *cells))
    turns = contender.values(lambda took: took.typical)
    table.figures.append(
        {
            "name": name,
            "typical": typical,
            "above_percent": above,
            "turns": turns,
            "failed_turns": contender.failed,
            "cpu": contender.cpu,
        }
    )
    return above
