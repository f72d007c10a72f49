"""Live values of a collector of a fleet on plain subjects of NATS: what was committed last, for displays.

Knows commits and subjects. Nothing here is kept or acknowledged: who needs every sample reads the stream.

1. A device's last batch is on ``busway.<zone>.live.<device>``: JSON with time (milliseconds since 1970 UTC), and by
   point the value and the reason why it is none.
2. Of batches of the same points that come together the last one is sent; while the server is away, none.
"""

import asyncio
import json
from importlib import import_module
from types import TracebackType
from typing import Any, Final, Self

from ..collector.collector import Collector
from ..collector.samples import PointGroup, SampleBatch, reason_text
from ..collector.sinks.nats import subject_token
from ..collector.store.writer import Commit
from .lease_driver import end_tasks

SEND_EVERY: Final = 0.2
_MILLION: Final = 1_000_000


class LiveSubjects:
    """Publishes the last values of a collector while the ``async with`` block lasts.

    Args:
        collector: the running collector.
        client: of nats-py, connected.
        zone: the zone of the collector.
    """

    def __init__(self, collector: Collector, client: Any, zone: str) -> None:
        self._client, self._zone = client, zone
        self._latest: dict[PointGroup, SampleBatch] = {}
        self._task: asyncio.Task[None] | None = None
        collector.subscribe(self._told)

    async def __aenter__(self) -> Self:
        """Begin to publish."""
        self._task = asyncio.create_task(self._send(), name="busway fleet live values")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End publishing."""
        assert self._task is not None
        await end_tasks([self._task])

    def _told(self, commit: Commit) -> None:
        for batch in commit.last_values:
            self._latest[batch.group] = batch

    async def _send(self) -> None:
        errors = import_module("nats.errors")
        while True:
            await asyncio.sleep(SEND_EVERY)
            latest, self._latest = self._latest, {}
            if not self._client.is_connected:
                continue
            try:
                for batch in latest.values():
                    await self._client.publish(
                        f"busway.{self._zone}.live.{subject_token(batch.device)}", encoded_batch(batch)
                    )
            except (errors.Error, OSError):
                continue  # the next ones come soon


def encoded_batch(batch: SampleBatch) -> bytes:
    """Return a batch of samples as the JSON of a live message."""
    points = {
        point: {"value": value, **({"reason": reason_text(reason)} if reason else {})}
        for point, value, reason in zip(batch.points, batch.values, batch.reason_column(), strict=True)
    }
    content = {"device": batch.device, "time": batch.time // _MILLION, "points": points}
    return json.dumps(content, separators=(",", ":"), default=str).encode()
