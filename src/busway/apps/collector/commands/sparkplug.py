"""Receives commands from host applications of Sparkplug B: values that they write to metrics of devices (DCMD).

Knows messages of the sink, whose connection they come over: an edge node has one. Knows no topic and no payload.

1. A command is sent within ``seconds`` of the time at which the host sent it by its own clock, and within ``seconds``
   of its arrival. A host whose clock is slow by more writes nothing, and the log says that its time was over.
2. A metric is the point of this name, exactly. A command has no key, since the standard has none: two are two writes.
3. Nothing is answered: the standard has no answers. The host sees the value that the device shows; journal, audit log
   and page have what became of the command.
4. The sink calls in a thread of its own; commands are executed in the event loop of the collector.
"""

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Callable
from functools import partial
from typing import Final

from ..sinks.sparkplug import SparkplugCommand
from .inputs import CommandReceiver, InputMessage, InputRights
from .message_tasks import MOST_AT_ONCE, MessageTasks

MOST_WAITING: Final = 4 * MOST_AT_ONCE
"""Commands that wait to be handled; further ones are refused."""
PLACE: Final = "{device}/{point}"

_log = logging.getLogger("busway.collector.commands")


class _Receiving:
    """The event loop in which commands are executed, and those that wait there."""

    def __init__(self, receiver: CommandReceiver, loop: asyncio.AbstractEventLoop) -> None:
        self.receiver, self._loop = receiver, loop
        self.waiting: asyncio.Queue[SparkplugCommand] = asyncio.Queue(MOST_WAITING)

    def call(self, called: Callable[[], object]) -> None:
        """Call a function in the event loop, from any thread."""
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(called)

    def queue(self, command: SparkplugCommand) -> None:
        """Queue a command, unless too many wait."""
        try:
            self.waiting.put_nowait(command)
        except asyncio.QueueFull:
            _log.warning("a command for %s/%s is refused: %d wait", command.device, command.point, MOST_WAITING)


class SparkplugCommands:
    """Receives commands to write points over a Sparkplug sink.

    Args:
        rights: what may be written; its place is `PLACE`.
        now: seconds since 1970 UTC.
    """

    kind: str = "sparkplug"
    separator: str = "/"

    def __init__(self, rights: InputRights, *, now: Callable[[], float] = time.time) -> None:
        self.rights: InputRights = rights
        self._now = now
        self._error: str | None = "not connected yet"
        self._receiving: _Receiving | None = None

    def level(self, name: str) -> str:
        """Return the name itself: metrics are called as points are."""
        return name

    # Called by the sink, in its thread.

    def take(self, command: SparkplugCommand) -> None:
        """Queue a command for the event loop of the collector."""
        receiving = self._receiving
        if receiving is not None:
            receiving.call(partial(receiving.queue, command))

    def note(self, error: str | None) -> None:
        """Note why no commands can come; None when they can."""
        self._error = error
        receiving = self._receiving
        if receiving is not None:
            receiving.call(partial(self._tell, receiving.receiver))

    # In the event loop of the collector.

    async def run(self, receiver: CommandReceiver) -> None:
        """Execute commands until cancelled."""
        receiving = self._receiving = _Receiving(receiver, asyncio.get_running_loop())
        self._tell(receiver)
        try:
            async with MessageTasks() as tasks:
                while True:
                    command = await receiving.waiting.get()
                    await tasks.begin(partial(self._handle, command, receiver))
        finally:
            self._receiving = None

    def _tell(self, receiver: CommandReceiver) -> None:
        """Set the status of the receiver to that of the sink's connection."""
        error = self._error
        if error is None:
            receiver.connected()
        else:
            receiver.down(error)

    async def _handle(self, command: SparkplugCommand, receiver: CommandReceiver) -> None:
        left = None if command.sent is None else command.sent + self.rights.seconds - self._now()
        message = InputMessage(
            PLACE.replace("{device}", command.device).replace("{point}", command.point),
            json.dumps({"value": command.value}).encode(),
            seconds_left=left,
            is_retained=command.is_retained,
        )
        await receiver.take(message)
