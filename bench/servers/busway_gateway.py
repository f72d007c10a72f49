"""A busway gateway on TCP, everything to one server behind.

Run from `bench/`:
    python -m servers.busway_gateway URL [--connections N] [--uvloop] [--no-sharing] [--real-time]
                                        [--observed AUDIT_FILE]
--observed: with metrics, a policy of twelve rules, and an audit log.
"""

import argparse
import asyncio
from urllib.parse import urlsplit

from harness import announce
from harness.priority import PROGRAM, real_time

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import simple_plan
from busway.observe.metrics.observer import MetricsObserver
from servers.twelve_rules import twelve_rules


async def main(url: str, connections: int, share_reads: bool, audit: str | None) -> None:
    options = {"max_transactions": 16, "queue": 4096} if url.startswith("tcp:") else {}
    if connections > 1:
        options["connections"] = connections
    plan = simple_plan(["tcp://127.0.0.1:0"], url, share_reads=share_reads, **options)
    observed = {}
    if audit is not None:
        observed = {"policy": twelve_rules(), "audit": busway.AuditLog(audit), "observers": [MetricsObserver()]}
    async with Gateway(plan, **observed) as gateway:
        announce.port(urlsplit(gateway.endpoints[0]).port or 0)
        await asyncio.Event().wait()


parser = argparse.ArgumentParser()
parser.add_argument("url")
parser.add_argument("--connections", type=int, default=1)
parser.add_argument("--uvloop", action="store_true")
parser.add_argument("--no-sharing", action="store_true")
parser.add_argument("--real-time", action="store_true")
parser.add_argument("--observed", metavar="AUDIT_FILE")
asked = parser.parse_args()
if asked.real_time:
    real_time(PROGRAM)
serving = main(asked.url, asked.connections, not asked.no_sharing, asked.observed)
if asked.uvloop:
    import uvloop

    uvloop.run(serving)
else:
    asyncio.run(serving)
