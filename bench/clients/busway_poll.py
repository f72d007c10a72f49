"""busway as the poller of a large plant: so many devices, each asked for some ranges once a second, by one process.

Run from `bench/`: python -m clients.busway_poll PORT SECONDS DEVICES READS REGISTERS [--uvloop]

Each device has an address of its own, 127.x.y.z, so each has a link of its own; a server on all addresses plays them.
Devices come due evenly over the second, those of one hundredth together. Latency runs from the time when a device was
due to the moment when its caller has all its values. One line of JSON, like that of the paced load generator; rate and
CPU time are of the polls that ended while the clock ran, whenever they were due.

It does what a program should that holds ten thousand links for long: those of one moment share one timer, and what is
there to stay is frozen, so that the collector of garbage does not look at half a million objects again and again.
"""

import asyncio
import gc
import json
import sys
import time
from array import array
from contextlib import AsyncExitStack

import busway

PERIOD = 1.0
STEP = 0.01
"""Seconds between two groups of devices."""
LATE = 0.1
DIALLED_TOGETHER = 500


class Poll:
    """Counts what is counted of a run."""

    def __init__(self, begin: float, seconds: float) -> None:
        self.start = begin + PERIOD  # the first round is not counted
        self.stop = self.start + seconds
        self.latencies = array("d")
        self.missing = 0
        self.ended = 0

    def done(self, due: float, now: float) -> None:
        self.ended += 1
        if self.start <= due < self.stop:
            self.latencies.append(now - due)


class Turns:
    """Wakes the devices of one moment together: one timer of the event loop for all of them."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._at: dict[float, asyncio.Future[None]] = {}

    def at(self, due: float, delay: float) -> "asyncio.Future[None]":
        """Done when ``due`` has come, in ``delay`` seconds."""
        turn = self._at.get(due)
        if turn is None:
            turn = self._at[due] = self._loop.create_future()
            self._loop.call_at(self._loop.time() + delay, self._ring, due)
        return turn

    def _ring(self, due: float) -> None:
        self._at.pop(due).set_result(None)


async def device(
    unit: busway.AsyncUnit, first: float, poll: Poll, turns: Turns, batch: list[busway.Request], registers: int
) -> None:
    due = first
    while due < poll.stop:
        delay = due - time.perf_counter()
        if delay > 0:
            await turns.at(due, delay)
        replies = await unit.execute_many(batch)
        now = time.perf_counter()
        if len(replies) != len(batch) or len(replies[-1].data) != 2 * registers:
            raise SystemExit(f"wrong replies: {replies}")
        poll.done(due, now)
        due += PERIOD
        while due < now:  # its next turn has gone by
            poll.missing += poll.start <= due < poll.stop
            due += PERIOD


async def main(port: int, seconds: float, devices: int, reads: int, registers: int) -> None:
    batch: list[busway.Request] = [busway.ReadHoldingRegisters(registers * one, registers) for one in range(reads)]
    async with AsyncExitStack() as opened:
        links = []
        for number in range(devices):
            host = f"127.{1 + number // 62500}.{number // 250 % 250}.{1 + number % 250}"
            link = busway.open(f"tcp://{host}:{port}", max_transactions=min(reads, 16), timeout=5)
            links.append(await opened.enter_async_context(link))
        for at in range(0, devices, DIALLED_TOGETHER):
            await asyncio.gather(*(link.connect() for link in links[at : at + DIALLED_TOGETHER]))
        turns = Turns()
        gc.collect()
        gc.freeze()
        begin = time.perf_counter() + 0.2
        poll = Poll(begin, seconds)
        groups = round(PERIOD / STEP)
        tasks = [
            asyncio.create_task(device(link.unit(1), begin + number % groups * STEP, poll, turns, batch, registers))
            for number, link in enumerate(links)
        ]
        await asyncio.sleep(poll.start - time.perf_counter())
        before, counted_from, already = time.process_time(), time.perf_counter(), poll.ended
        await asyncio.sleep(poll.stop - time.perf_counter())
        cpu, lasted = time.process_time() - before, time.perf_counter() - counted_from
        ended = poll.ended - already
        await asyncio.gather(*tasks)
    report(poll, cpu, lasted, reads * ended)


def report(poll: Poll, cpu: float, lasted: float, transactions: int) -> None:
    ordered = sorted(poll.latencies)
    if not ordered:
        raise SystemExit("no device was polled in time")
    found: dict[str, float] = {"transactions": transactions, "seconds": lasted, "rate": transactions / lasted}
    for name, share in (("p50", 0.50), ("p99", 0.99), ("p99.9", 0.999)):
        found[name] = ordered[int(share * len(ordered))] * 1e6
    found |= {"longest": ordered[-1] * 1e6, "late": sum(each > LATE for each in ordered), "missing": poll.missing}
    print(json.dumps(found | {"cpu": cpu}))


run = asyncio.run
if "--uvloop" in sys.argv:
    import uvloop

    run = uvloop.run
run(main(int(sys.argv[1]), float(sys.argv[2]), *map(int, sys.argv[3:6])))
