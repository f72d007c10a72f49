"""A program that collects by a file until it is ended, and says what happens to alarms.

    python alarm_worker.py FILE [--acknowledge]

Prints a line for each event that is in the journal; with ``--acknowledge`` acknowledges what is raised as ``anna``.
"""

import asyncio
import sys

import busway


async def main() -> None:
    async with busway.collect(sys.argv[1]) as collector:
        print("began", *(f"{each.limit}={each.state}" for each in collector.alarms.active()), sep="|", flush=True)
        async for event in collector.alarms.events():
            print(event.limit, event.kind, event.by, sep="|", flush=True)
            if event.kind == "raised" and "--acknowledge" in sys.argv:
                await collector.alarms.acknowledge(event.device, event.point, event.limit, "anna")


if __name__ == "__main__":
    asyncio.run(main())
