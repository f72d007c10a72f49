"""A busway server on a host of the network tests, told by lines of JSON.

Use: python server.py ENDPOINT OPTIONS, with OPTIONS as JSON. Holding register n of unit 1 holds n; a read from address
1000 on waits until it is told to go on. Questions: ``status``, ``until`` (so many ``connections`` or ``waiting``
requests within ``seconds``), ``go_on``.
"""

import asyncio
import json
import os
import sys
import time
from typing import Any

import busway
from busway.pdu.functions import AnyRequest
from busway.session.responder import ResponderAnswer, ServedUnit

SLOW = 1000


class HeldReplies:
    """A device whose upper half answers when it is told to."""

    functions = busway.STANDARD
    generation = 0

    def __init__(self) -> None:
        self.opened = asyncio.Event()

    def serves(self, unit: int) -> ServedUnit | None:
        return ServedUnit(unit)

    def answer(self, context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
        """Answer with addresses, or with what was written."""
        if isinstance(request, busway.WriteSingleRegister):
            return busway.WriteSingleRegister.Reply(request.address, request.value)
        assert isinstance(request, busway.ReadHoldingRegisters)
        reply = busway.ReadHoldingRegisters.Reply(request.address.to_bytes(2, "big"))
        return reply if request.address < SLOW else self._wait(reply)

    async def _wait(self, reply: busway.Message) -> busway.Message:
        await self.opened.wait()
        return reply


def status(server: busway.Server) -> dict[str, Any]:
    """What the tests look at."""
    now = server.status()
    return {
        "connections": [one.peer for one in now.connections],
        "pools": [one.pool.value for one in now.connections],
        "waiting": sum(one.waiting for one in now.connections),
        "accepted": now.counters.accepted,
        "closed": now.counters.closed,
        "evicted": now.counters.evicted,
        "requests": now.counters.requests,
        "handles": len(os.listdir("/proc/self/fd")),
    }


async def until(server: busway.Server, asked: dict[str, Any]) -> dict[str, Any]:
    """The status as soon as it is as wanted, or when the time is over; ``seconds`` says how long it took."""
    began = time.monotonic()
    while True:
        now = status(server)
        took = time.monotonic() - began
        come = len(now["connections"]) == asked.get("connections", len(now["connections"]))
        if (come and now["waiting"] == asked.get("waiting", now["waiting"])) or took > asked["seconds"]:
            return {**now, "seconds": took}
        await asyncio.sleep(0.01)


async def main(endpoint: str, options: dict[str, Any]) -> None:
    """Serve until the input ends."""
    held_replies = HeldReplies()
    loop = asyncio.get_running_loop()
    async with busway.serve(endpoint, responder=held_replies, **options) as server:
        print("ready", flush=True)
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            asked = json.loads(line)
            if asked["do"] == "go_on":
                held_replies.opened.set()
                answer = status(server)
            else:
                answer = await until(server, asked) if asked["do"] == "until" else status(server)
            print(json.dumps(answer), flush=True)


asyncio.run(main(sys.argv[1], json.loads(sys.argv[2])))
