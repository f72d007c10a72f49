"""A server that stands a flood, in a process of its own.

Use: python flooded.py ENDPOINT ACCESS PRIORITY TRANSPORTS, where ACCESS is ``read-only``, ``everything``, or the URL of
a server to stand before as a gateway; PRIORITY is the address of the priority host, TRANSPORTS ``epoll`` or ``loop``.
The first line says its port. It ends with its input.
"""

import asyncio
import sys
from contextlib import AsyncExitStack

import busway
import busway.server.opening


async def main(endpoint: str, access: str, priority: str, transports: str) -> None:
    """Serve until the input ends."""
    if transports == "loop":
        busway.server.opening.epoll_set_for = lambda loop: None  # type: ignore[assignment]
    async with AsyncExitStack() as stack:
        server: busway.Server | busway.Gateway
        if "://" in access:
            gateway = busway.simple_gateway([endpoint], access, changes={"priority": [priority]})
            server = gateway.serve()
        else:
            device = busway.Device(holding_registers=list(range(65_536)))
            policy = busway.Policy.read_only() if access == "read-only" else None
            server = busway.serve(endpoint, units=device, priority=[priority], policy=policy)
        await stack.enter_async_context(server)
        print(server.endpoints[0].rpartition(":")[2], flush=True)
        await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)


asyncio.run(main(*sys.argv[1:5]))
