"""A busway server on TCP or TLS with 65 536 holding registers for unit 1, register n holding n.

Run from `bench/`: python -m servers.busway_server [--uvloop] [--trace-memory] [--policy] [--audit FILE]
                   [--all-tables] [--scheme tcp|udp|rtu+tcp] [--tls CERTIFICATE KEY AUTHORITY]
--policy: twelve rules, of which some are about the table that is asked; --audit: writes go into a log;
--all-tables: coils, discrete inputs and input registers too.
"""

import argparse
import asyncio
from urllib.parse import urlencode, urlsplit

from harness import announce

import busway
from servers.twelve_rules import twelve_rules


async def main(asked: argparse.Namespace) -> None:
    bits, registers = [False] * 65536, [0] * 65536
    others = {"coils": bits, "discrete_inputs": bits, "input_registers": registers} if asked.all_tables else {}
    device = busway.Device(holding_registers=list(range(65536)), **others)
    url = f"{asked.scheme}://127.0.0.1:0"
    if asked.tls:
        url = f"tls://127.0.0.1:0?{urlencode(dict(zip(('certificate', 'key', 'authority'), asked.tls, strict=True)))}"
    audit = busway.AuditLog(asked.audit) if asked.audit else None
    policy = twelve_rules() if asked.policy else None
    options = {"units": {1: device}, "policy": policy, "audit": audit, "max_connections": 20_000}
    async with busway.serve(url, **options) as server:
        announce.port(urlsplit(server.endpoints[0]).port or 0)
        await asyncio.Event().wait()


parser = argparse.ArgumentParser()
parser.add_argument("--uvloop", action="store_true")
parser.add_argument("--trace-memory", action="store_true")
parser.add_argument("--policy", action="store_true")
parser.add_argument("--all-tables", action="store_true")
parser.add_argument("--audit")
parser.add_argument("--scheme", default="tcp")
parser.add_argument("--tls", nargs=3)
asked = parser.parse_args()
if asked.trace_memory:
    announce.trace_memory()
serving = main(asked)
if asked.uvloop:
    import uvloop

    uvloop.run(serving)
else:
    asyncio.run(serving)
