"""What an acknowledged message of samples costs: the stream of a fleet beside nats-py with the same bytes. Prints JSON.

    fleet_batches.py PORT SECONDS ROUNDS

1. A message has the samples of one link: devices of 50 points, read once a second. The small one has 8 kB. The large
   one is the largest that an outbox makes of them: it computes before how long a message can become at most, 64 kB, and
   these samples then have 40 kB.
2. Bare: the bytes of the message, made before, published by nats-py to the same stream, one after the other, each
   acknowledged. Ours: the message as the outbox of a collector gives it to its stream: encoded, named, acknowledged.
3. CPU time is that of this process; both take turns in it, and each turn has a ratio of its own.
"""

import asyncio
import json
import random
import statistics
import sys
import time
from collections.abc import Awaitable, Callable

from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.fleet.coordinators.nats import open_nats
from busway.apps.fleet.coordinators.opening import CoordinatorOptions
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.messages import Chain, SampleMessage
from busway.apps.fleet.streams import NatsStream, make_stream

BEGIN = 1_800_000_000 * 10**9
SIZES = {"8 kB": 248, "40 kB": 1340}
"""Samples of a message."""
POINTS = 50


def message(samples: int, number: int) -> SampleMessage:
    chance = random.Random(number)
    rows = [
        CommittedSample(
            1000 * number + place // 1000,
            f"meter-{place // POINTS % 20}",
            f"point-{place % POINTS}",
            BEGIN + number * 10**9 + place // POINTS * 2_000_000,
            4_321_000,
            round(chance.uniform(0, 400), 1),
            0,
            "V",
        )
        for place in range(samples)
    ]
    return SampleMessage("west", "store", "hall", Epoch(1, 7), 3, 1000 * number, 0, rows, Chain(1, number))


async def repeated(work: Callable[[int], Awaitable[object]], seconds: float) -> tuple[float, float]:
    """Seconds and CPU seconds of one call, of as many as there is time for, and of one at least."""
    calls, now = 0, time.perf_counter()
    begin, cpu = now, time.process_time()
    while not calls or now < begin + seconds:
        await work(calls)
        calls += 1
        now = time.perf_counter()
    return (now - begin) / calls, (time.process_time() - cpu) / calls


async def measured(port: int, seconds: float, rounds: int) -> dict[str, dict[str, float]]:
    coordinator = await open_nats(f"nats://127.0.0.1:{port}", "bench", CoordinatorOptions())
    client = coordinator.client
    await make_stream(client, "bench")
    stream, bare = NatsStream(client, "bench"), client.jetstream(timeout=5.0)
    found: dict[str, dict[str, float]] = {}
    for name, samples in SIZES.items():
        messages = [message(samples, number) for number in range(1, 41)]
        encoded = [each.encode() for each in messages]
        rows: dict[str, list[tuple[float, float]]] = {"bare": [], "ours": [], "encoding": []}

        async def publish_bare(number: int, encoded: list[bytes] = encoded) -> None:
            await bare.publish("busway.bench.samples.0001", encoded[number % len(encoded)])

        async def publish(number: int, messages: list[SampleMessage] = messages) -> None:
            await stream.publish(messages[number % len(messages)], "0001")

        async def encode(number: int, messages: list[SampleMessage] = messages) -> None:
            messages[number % len(messages)].encode()

        for _ in range(rounds):
            for kind, work in (("bare", publish_bare), ("ours", publish), ("encoding", encode)):
                rows[kind].append(await repeated(work, seconds))
        found[name] = {"bytes": statistics.mean(map(len, encoded)), "samples": samples}
        for kind, each in rows.items():
            found[name][f"{kind}, s"] = statistics.median(wall for wall, _ in each)
            found[name][f"{kind}, CPU s"] = statistics.median(cpu for _, cpu in each)
        both = list(zip(rows["ours"], rows["bare"], strict=True))
        found[name]["ratio, s"] = statistics.median(ours[0] / other[0] for ours, other in both)
        found[name]["ratio, CPU"] = statistics.median(ours[1] / other[1] for ours, other in both)
    await coordinator.close()
    return found


if __name__ == "__main__":
    print(json.dumps(asyncio.run(measured(int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])))))
