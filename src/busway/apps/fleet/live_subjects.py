"""Live values of a collector of a fleet on plain subjects of NATS: the values committed last, for displays.

Knows commits and subjects. Messages are neither kept nor acknowledged: a program that needs every sample reads the
stream.

1. Each batch goes to ``busway.<zone>.live.<device>``; in the name of the device ``.``, ``*``, ``>`` and white space are
   ``_``. It has the points of one read, not all of the device. JSON: ``{"device": …, "time": …, "points": {"power":
   {"value": …, "reason": …}}}``, time in milliseconds since 1970 UTC, reason only if the quality is not good. NaN and
   infinities are texts.
2. Of several batches of the same points within `SEND_EVERY` seconds only the last is sent. What cannot be sent, because
   there is no connection to the server or it fails, is dropped.
"""

import asyncio
import json
import logging
from importlib import import_module
from types import TracebackType
from typing import Any, Final, Self

from ..collector.cancellation import end_tasks
from ..collector.collector import Collector
from ..collector.samples import PointGroup, SampleBatch, reason_text
from ..collector.sinks.documents import json_number
from ..collector.sinks.nats import subject_token
from ..collector.store.writer import Commit

SEND_EVERY: Final = 0.2
PAUSE: Final = 15.0
"""Seconds for which no live values are sent after an unexpected error."""
_MILLION: Final = 1_000_000
_log = logging.getLogger("busway.fleet")


class LiveSubjects:
    """Publishes the last values of a collector on subjects of NATS while the ``async with`` block lasts.

    Args:
        collector: the running collector.
        client: connected client of nats-py.
        zone: name of the collector's zone.
    """

    def __init__(self, collector: Collector, client: Any, zone: str) -> None:
        self._client, self._zone = client, zone
        self._latest: dict[PointGroup, SampleBatch] = {}
        self._task: asyncio.Task[None] | None = None
        collector.subscribe(self._told)

    async def __aenter__(self) -> Self:
        """Start a task that publishes the values that the collector commits."""
        self._task = asyncio.create_task(self._send(), name="busway fleet live values")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop publishing. The client stays connected."""
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
                for batch in sorted(latest.values(), key=_time_of):  # a point may be in several of them
                    await self._client.publish(
                        f"busway.{self._zone}.live.{subject_token(batch.device)}", encoded_batch(batch)
                    )
            except (errors.Error, OSError):
                continue  # the next ones come soon
            except Exception:  # a defect, whatever it is: later values are sent all the same
                _log.exception("live values cannot be sent; it is tried again")
                await asyncio.sleep(PAUSE)


def _time_of(batch: SampleBatch) -> int:
    return batch.time


def encoded_batch(batch: SampleBatch) -> bytes:
    """Return a batch of samples as a message with live values: JSON, as in rule 1."""
    points = {
        point: {"value": json_number(value), **({"reason": reason_text(reason)} if reason else {})}
        for point, value, reason in zip(batch.points, batch.values, batch.reason_column(), strict=True)
    }
    content = {"device": batch.device, "time": batch.time // _MILLION, "points": points}
    return json.dumps(content, separators=(",", ":"), default=str).encode()
