"""A gateway from TCP to a serial line: what it adds to a transaction, beside a master that has the line for itself.

Reads of 10 registers over RTU on a paced line, 115 200 baud 8E1, from one server of ours. The line has one core, all
others share the other one; all ask for real-time priority where that is allowed. First our master directly on the line,
lock-step; then a client over TCP through a gateway, lock-step; then two clients, so that one request is always waiting
when the line becomes free. The floor is what characters and t3.5 take at least.

`typical` is the middle time from one reply to the next. What a gateway adds is taken round by round against the master
on the line.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field

from harness import children
from harness.bench import Bench, Command
from harness.children import ChildFailed
from harness.measure import median, spread
from harness.report import Bar, Table

from tables.line import REGISTERS, least

BAUD = 115_200
READS = 100
COLUMNS = ("", "typical ms", "± %", "above the master %", "CPU ms each")
MASTER = "busway as master, on the line"
Way = Callable[[str], Command]
"""A gateway's command for the path of its line."""


@dataclass(slots=True)
class Contender:
    """What stands between the client and the line (None: nothing), how many clients there are, what was measured."""

    gateway: Way | None
    clients: int
    typical: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    missing: str = ""


def run(bench: Bench) -> Table:
    reads = READS // 4 if bench.quick else READS
    table = Table(f"Gateway, TCP to a line: {reads} x FC03 x {REGISTERS} registers, RTU {BAUD} 8E1", COLUMNS)
    contenders = {MASTER: Contender(None, 1)}
    for name, way in _ways(bench).items():
        contenders[f"{name}, lock-step"] = Contender(way, 1)
        contenders[f"{name}, 2 clients"] = Contender(way, 2)
    for _ in range(bench.rounds):
        for name, contender in contenders.items():
            _measure(bench, name, contender, reads)
    floor = f"{least(BAUD) * 1000:.3f}"
    table.rows.append(("floor: characters and silences", floor, "", "", ""))
    table.figures.append({"name": "floor", "typical": least(BAUD)})
    added = {name: _add(table, name, one, contenders[MASTER]) for name, one in contenders.items()}
    table.bars = [
        Bar("busway gateway, lock-step: above the master", added["busway gateway, lock-step"], "<=", 5, "%"),
        Bar("busway gateway, 2 clients: above the master", added["busway gateway, 2 clients"], "<=", 2, "%"),
    ]
    return table


def _ways(bench: Bench) -> dict[str, Way]:
    def ours(path: str) -> Command:
        return bench.ours("servers.busway_gateway", f"rtu://{path}?baud={BAUD}", "--no-sharing", "--real-time")

    ways: dict[str, Way] = {
        "busway gateway": ours,
        "pyModbusTCP gateway": lambda path: bench.peer("peers.tcp2rtu_gateway", path, BAUD),
    }
    mbusd = shutil.which("mbusd")
    if mbusd is None:
        bench.say("mbusd is not on PATH and left out")
    else:
        ways["mbusd"] = lambda path: bench.ours("servers.mbusd", mbusd, path, BAUD)
    return ways


def _measure(bench: Bench, name: str, contender: Contender, reads: int) -> None:
    if contender.missing:
        return
    try:
        with children.server(bench.ours("servers.paced_line", BAUD), bench.server_core, "line") as line:
            master, serving = line.told
            url = f"rtu://{serving}?baud={BAUD}"
            with children.server(bench.ours("servers.busway_line_server", url), bench.load_core, "serving"):
                result = _asked(bench, contender, master, reads)
    except ChildFailed as failure:
        contender.missing = str(failure)
        bench.say(f"gateway_line: {name} is left out: {failure}")
        return
    contender.typical.append(result["typical"])
    contender.cpu.append(result["cpu"])
    bench.say(f"gateway_line: {name:<34} {result['typical'] * 1000:.3f} ms")


def _asked(bench: Bench, contender: Contender, master: str, reads: int) -> dict[str, float]:
    def client(url: str) -> dict[str, float]:
        words = (url, contender.clients, reads // contender.clients, REGISTERS)
        found = children.run(bench.ours("clients.busway_lockstep", *words), bench.load_core, 20 * reads * least(BAUD))
        return {"typical": found["typical"], "cpu": found["cpu"] / found["reads"]}

    if contender.gateway is None:
        return client(f"rtu://{master}?baud={BAUD}")
    with children.server(contender.gateway(master), bench.load_core) as gateway:
        return client(f"tcp://127.0.0.1:{gateway.port}")


def _add(table: Table, name: str, contender: Contender, master: Contender) -> float | None:
    """Add a row; gives what is above the master in per cent."""
    typical, off = median(contender.typical), spread(contender.typical)
    if typical is None or off is None:
        table.rows.append((name, "–", "", "", ""))
        table.figures.append({"name": name, "missing": contender.missing})
        return None
    pairs = zip(contender.typical, master.typical, strict=False)
    above = median([(mine / theirs - 1) * 100 for mine, theirs in pairs])
    cpu = median(contender.cpu) or 0.0
    cells = ("" if contender is master or above is None else f"{above:.1f}", f"{cpu * 1000:.2f}")
    table.rows.append((name, f"{typical * 1000:.3f}", f"{off:.0f}", *cells))
    table.figures.append(
        {"name": name, "typical": typical, "above_percent": above, "rounds": contender.typical, "cpu": cpu}
    )
    return above
