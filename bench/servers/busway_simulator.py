"""500 simulated units with 100 points each that change once a second, behind two ports: a server has 256 units at most.

Run from `bench/`: python -m servers.busway_simulator [--uvloop]; answers SIGUSR2 by `changes N LEFT_OUT`.
"""

import asyncio
import signal
import sys
from urllib.parse import urlsplit

from busway.apps.simulator.includes import parse_declaration
from busway.apps.simulator.simulation import Simulation

UNITS = 250  # behind each port
POINTS = 100
KINDS = (
    ("float32", 'kind = "sine", mean = 230.0, amplitude = 4.0, period = 60'),
    ("int16", 'kind = "noise", mean = 100, spread = 50'),
    ("uint32", 'kind = "counter", rate = 3.5'),
    ("uint16", 'kind = "ramp", last = 1000, duration = 100'),
    ("float32", 'kind = "random-walk", step = 1'),
    ("float32", 'kind = "formula", formula = "p0 * p1"'),
    ("float32", 'kind = "lag", target = "p0", time_constant = 30'),
    ("int32", 'kind = "sine", amplitude = 1000000, period = 30'),
    ("uint16", 'kind = "ramp", last = 60000, duration = 600'),
    ("float32", 'kind = "noise", mean = 5, spread = 1, distribution = "gauss"'),
)


def _profile() -> str:
    lines = ["[[unit]]"]
    offset = 0
    for index in range(POINTS):
        kind, behaviour = KINDS[index % len(KINDS)]
        lines += ["[[unit.point]]", f'name = "p{index}"', f'address = "input:{offset}"', f'type = "{kind}"']
        lines += [f"behaviour = {{ {behaviour} }}"]
        offset += 2 if kind.endswith("32") else 1
    return "\n".join(lines)


async def main() -> None:
    plant = f'[[include]]\nfile = "meter.toml"\nunits = "1-{UNITS}"\n'
    declaration = parse_declaration(plant, "plant.toml", read=lambda name: _profile())
    one, other = Simulation(declaration), Simulation(declaration, seed=1)

    def tell(*_: object) -> None:
        print(f"changes {one.changes + other.changes} {one.left_out + other.left_out}", flush=True)

    async with one.running("tcp://127.0.0.1:0"), other.running("tcp://127.0.0.1:0"):
        signal.signal(signal.SIGUSR2, tell)
        ports = " ".join(str(urlsplit(each.server.endpoints[0]).port) for each in (one, other))
        print(f"port {ports}", flush=True)
        await asyncio.Event().wait()


if "--uvloop" in sys.argv:
    import uvloop

    uvloop.run(main())
else:
    asyncio.run(main())
