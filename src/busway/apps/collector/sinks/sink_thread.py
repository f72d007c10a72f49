"""Runs all sinks of a store in a thread with an event loop of its own, so that no sink delays polling.

Knows threads and tasks; does not know what a delivery does.
"""

import asyncio
import contextlib
import logging
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from ....errors import ConfigError
from ....options.sinks import DeliveryOptions
from ....points.point import Point
from ....points.point_rules import ReportRule
from ..cancellation import end_tasks
from ..store.writer import StoreWriter
from .delivery import PAUSE_LIMIT, Delivery, SinkStatus
from .interface import DescribedSink, Sink

CLOSE: Final = 10.0
"""Seconds in which a sink can be expected to close."""
FINISH: Final = 2.0
"""Seconds within which a sink that is removed, or a program that ends, may finish the batch that it is sending."""

_log = logging.getLogger("busway.sinks")


@dataclass(slots=True, eq=False)
class _RunningSink:
    """A sink, the delivery to it, and the task that runs the delivery; the task is None until it has begun."""

    sink: Sink
    delivery: Delivery
    task: asyncio.Task[None] | None = None


class SinkThread:
    """The thread that sends the samples of a store to all its sinks, from its creation until `close`.

    `add`, `remove` and `set_points` must be called in one thread, that of the collector.
    """

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
            sinks: each sink with the options of its delivery, by name; a sink continues at the cursor of its name.
            point_rules: by device and point, the report rules of points of which only some samples are sent. None for
                no rules.
            points: by device and name, the points in the configuration; None for all points of the store.

        Raises:
            ConfigError: a name is empty or has a character that a file's name cannot have.
            sqlite3.Error: the manifest cannot be written.
        """
        for name in sinks:
            _check_name(name)
        self._writer, self._rules, self._points = writer, point_rules or {}, points
        self._running: dict[str, _RunningSink] = {}
        self._loop = asyncio.new_event_loop()
        self._ending = asyncio.Event()
        with contextlib.ExitStack() as unless_added:
            unless_added.callback(self._loop.close)
            for name, (sink, options) in sinks.items():
                self.add(name, sink, options)
            unless_added.pop_all()
        self._thread = threading.Thread(target=self._run, name="busway-sinks", daemon=True)
        self._thread.start()

    def add(self, name: str, sink: Sink, options: DeliveryOptions) -> None:
        """Begin to send to one more sink, after the last commit that a sink of this name has got, if any.

        Args:
            name: name of the sink; none of this name is running.
            sink: the sink.
            options: the options of its delivery.

        Raises:
            ConfigError: the name is empty or has a character that a file's name cannot have.
            sqlite3.Error: the manifest cannot be written; nothing has begun.
        """
        _check_name(name)
        if self._points is not None and isinstance(sink, DescribedSink):
            sink.describe(self._points)
        writer = self._writer
        delivery = Delivery(
            name, sink, writer.folder, writer.manifest, options, point_rules=self._rules, points=self._points
        )
        running = self._running[name] = _RunningSink(sink, delivery)
        self._loop.call_soon_threadsafe(self._begin, running)

    def reserve(self, name: str) -> None:
        """Write the cursor of a sink into the manifest, so that a later `add` cannot fail at that.

        A sink that has no cursor yet gets 0, the begin of the store.

        Raises:
            sqlite3.Error: the manifest cannot be written.
        """
        manifest = self._writer.manifest
        manifest.set_cursor(name, *manifest.cursors().get(name, (0, 0)))

    def remove(self, name: str, timeout: float = 10.0) -> None:
        """Stop sending to a sink, and wait until its delivery has ended.

        The cursor stays in the manifest: a sink of the same name that is added later continues there. The batch that is
        being sent may arrive first, within `FINISH` seconds, so that it is not sent again. If the delivery has not
        ended after ``timeout`` seconds, this is logged, and the method returns.
        """
        running = self._running.pop(name)
        ended = asyncio.run_coroutine_threadsafe(_finish(running), self._loop)
        try:
            ended.result(timeout)
        except TimeoutError:
            _log.warning("sink %s does not end its connection within %g s; it is left", name, timeout)

    def set_points(self, points: Mapping[tuple[str, str], Point], rules: Mapping[tuple[str, str], ReportRule]) -> None:
        """Use the points and report rules of a configuration that was read again.

        Args:
            points: by device and name, the points in the configuration.
            rules: by device and point, the report rules of points of which only some samples are sent.
        """
        self._points, self._rules = points, rules
        for running in self._running.values():
            if isinstance(running.sink, DescribedSink):
                running.sink.describe(points)
            running.delivery.set_points(points, rules)

    def statuses(self) -> Sequence[SinkStatus]:
        """Return the status of each sink. Safe from any thread."""
        return [each.delivery.status() for each in list(self._running.values())]

    def close(self, timeout: float = 10.0) -> None:
        """End the deliveries to all sinks, and wait for at most ``timeout`` seconds until the thread has ended.

        A batch that is being sent may arrive within `FINISH` seconds; one that is interrupted is sent again after the
        next start, and samples that are not sent yet are sent then.
        """
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join(timeout)

    # In the thread.

    def _begin(self, running: _RunningSink) -> None:
        running.task = asyncio.create_task(_guarded(running.delivery))

    def _run(self) -> None:
        # A runner ends and awaits what libraries have left behind too, such as a connection that was being made.
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._deliver())

    async def _deliver(self) -> None:
        await self._ending.wait()
        await asyncio.gather(*(_finish(each) for each in list(self._running.values())))


def _check_name(name: str) -> None:
    """Raise `ConfigError` for a name that a sink cannot have, because it could not be part of a file's name."""
    if not name or not all(each.isalnum() or each in "-_." for each in name) or name.startswith("."):
        raise ConfigError(f"{name!r} is no name of a sink: letters, digits, - _ . are possible", key="name")


async def _finish(running: _RunningSink) -> None:
    await running.delivery.finish(FINISH)
    await _end(running)


async def _end(running: _RunningSink) -> None:
    if running.task is not None:
        await end_tasks([running.task], CLOSE)


async def _guarded(delivery: Delivery) -> None:
    """Run the delivery to one sink until cancelled; after an unexpected error, log it, and run it again after a pause.

    The pause is `PAUSE_LIMIT` seconds.
    """
    while True:
        try:
            await delivery.run()
        except Exception as error:  # a defect of one sink, whatever it is: its status has it
            _log.exception("sink %s failed; it is tried again", delivery.name)
            delivery.note_defect(error)
            await asyncio.sleep(PAUSE_LIMIT)
