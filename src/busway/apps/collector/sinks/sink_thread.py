"""Runs all sinks of a store in a thread with an event loop of its own, so that no sink delays polling.

Knows threads and tasks; knows nothing of what a delivery does.
"""

import asyncio
import contextlib
import logging
import threading
from collections.abc import Mapping, Sequence

from ....errors import ConfigError
from ....options.sinks import DeliveryOptions
from ....points.point import Point
from ....points.point_rules import ReportRule
from ..store.writer import StoreWriter
from .delivery import PAUSE_LIMIT, Delivery, SinkStatus
from .interface import DescribedSink, Sink

_log = logging.getLogger("busway.sinks")


class SinkThread:
    """The thread that sends the samples of a store to all its sinks, from its creation until `close`."""

    def __init__(
        self,
        writer: StoreWriter,
        sinks: Mapping[str, tuple[Sink, DeliveryOptions]],
        point_rules: Mapping[tuple[str, str], ReportRule] | None = None,
        points: Mapping[tuple[str, str], Point] | None = None,
    ) -> None:
        """Start the thread and the delivery to each sink.

        Args:
            writer: the open store; the cursors of the sinks are in its manifest.
            sinks: each sink with the options of its delivery, by name; a name keeps its cursor over a restart.
            point_rules: by device and point, the report rules of points of which only some samples are sent.
            points: by device and name, the points that the configuration has; None for all of the store.

        Raises:
            ConfigError: a name is empty or has a character that a file's name cannot have.
        """
        for name in sinks:
            if not name or not all(each.isalnum() or each in "-_." for each in name) or name.startswith("."):
                raise ConfigError(f"{name!r} is no name of a sink: letters, digits, - _ . are possible", key="name")
        self._described = [sink for sink, _ in sinks.values() if isinstance(sink, DescribedSink)]
        if points is not None:
            self._describe(points)
        self._deliveries = [
            Delivery(name, sink, writer.folder, writer.manifest, options, point_rules=point_rules, points=points)
            for name, (sink, options) in sinks.items()
        ]
        self._loop = asyncio.new_event_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._is_ending = False
        self._thread = threading.Thread(target=self._run, name="busway-sinks", daemon=True)
        self._thread.start()

    def set_points(self, points: Mapping[tuple[str, str], Point], rules: Mapping[tuple[str, str], ReportRule]) -> None:
        """Use the points and report rules of a configuration that was read again. Safe from any thread.

        Args:
            points: by device and name, the points that the configuration has.
            rules: by device and point, the report rules of points of which only some samples are sent.
        """
        self._describe(points)
        for delivery in self._deliveries:
            delivery.set_points(points, rules)

    def _describe(self, points: Mapping[tuple[str, str], Point]) -> None:
        for sink in self._described:
            sink.describe(points)

    def statuses(self) -> Sequence[SinkStatus]:
        """Return the status of each sink. Safe from any thread."""
        return [delivery.status() for delivery in self._deliveries]

    def close(self, timeout: float = 10.0) -> None:
        """Stop sending to all sinks within ``timeout`` seconds; unsent samples are sent after the next start."""
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._cancel)
        self._thread.join(timeout)

    def _cancel(self) -> None:
        self._is_ending = True
        for task in self._tasks:
            task.cancel()

    def _run(self) -> None:
        # A runner ends and awaits what libraries have left behind too, such as a connection that was being made.
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._deliver())

    async def _deliver(self) -> None:
        self._tasks = {asyncio.create_task(self._guarded(delivery)) for delivery in self._deliveries}
        if self._is_ending:  # `close` came first
            self._cancel()
        if self._tasks:
            await asyncio.wait(self._tasks)

    @staticmethod
    async def _guarded(delivery: Delivery) -> None:
        """Run the delivery to one sink; after an unexpected error, log it, pause, and run the delivery again."""
        while True:
            try:
                await delivery.run()
            except Exception as error:  # a defect of one sink, whatever it is: its status has it
                _log.exception("sink %s failed; it is tried again", delivery.name)
                delivery.note_defect(error)
                await asyncio.sleep(PAUSE_LIMIT)
