"""Receives commands from host applications of Sparkplug B: values that they write to metrics of devices (DCMD).

Knows messages of the sink, whose connection they come over: an edge node has one. Knows no topic and no payload.

1. A command is sent within `InputRights.seconds` of the time at which the host sent it by its own clock, and of its
   arrival. If the clock of a host is slow by more than that, its commands expire, and the audit log says so.
2. A metric is the point with exactly this name. The standard has no keys of commands, so two equal commands are two
   writes.
3. Nothing is answered, because the standard has no answers. The host sees the value that the device shows; journal,
   audit log and page show the result of the command.
4. The sink runs in another thread, and calls from there; commands are executed in the event loop of the collector.
"""

import asyncio
import contextlib
import json
import time
from collections.abc import Callable
from functools import partial
from typing import Final

from ..sinks.sparkplug import SparkplugCommand
from .command_messages import CommandMessageHandler, InputMessage, InputRights
from .message_tasks import MessageTasks

PLACE: Final = "{device}/{point}"


class _Receiving:
    """The event loop, the tasks and the handler that commands of Sparkplug hosts are handed to.

    Attributes:
        handler: executes the commands.
    """

    def __init__(self, handler: CommandMessageHandler, tasks: MessageTasks, loop: asyncio.AbstractEventLoop) -> None:
        self.handler, self._tasks, self._loop = handler, tasks, loop

    def call(self, called: Callable[[], object]) -> None:
        """Have a function called in the event loop; safe from any thread. Nothing happens if the loop has ended."""
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(called)

    def begin(self, message: InputMessage) -> None:
        """Start a task that executes the command of a message; drop the message if too many wait."""
        if not self._tasks.begin(partial(self._handle, message)):
            self.handler.drop(message.where)

    async def _handle(self, message: InputMessage) -> None:
        await self.handler.handle(message)


class SparkplugCommands:
    """Receives commands to write points from Sparkplug hosts, over the connection of a Sparkplug sink.

    Args:
        rights: the points that may be written; its topic pattern is `PLACE`.
        now: returns seconds since 1970 UTC.
    """

    kind: str = "sparkplug"
    separator: str = "/"

    def __init__(self, rights: InputRights, *, now: Callable[[], float] = time.time) -> None:
        self.rights: InputRights = rights
        self._now = now
        self._error: str | None = "not connected yet"
        self._receiving: _Receiving | None = None

    def level(self, name: str) -> str:
        """Return the name unchanged: a Sparkplug metric has the name of its point."""
        return name

    # Called by the sink, in its thread.

    def take(self, command: SparkplugCommand) -> None:
        """Hand a command of a Sparkplug host to the collector's event loop, and return at once. Safe from any thread.

        A command that comes while `run` is not running is dropped, and not counted.
        """
        receiving = self._receiving
        if receiving is not None:
            receiving.call(partial(receiving.begin, self._message(command)))

    def note(self, error: str | None) -> None:
        """Set why no commands can arrive, for the status; None if they can. Called by the sink, from its thread."""
        self._error = error
        receiving = self._receiving
        if receiving is not None:
            receiving.call(partial(self._copy_status, receiving.handler))

    # In the event loop of the collector.

    def join(self, group: str, member: str) -> bool:
        """Return False: messages are not shared. Each collector of a fleet is an edge node of its own."""
        return False

    async def run(self, handler: CommandMessageHandler) -> None:
        """Have ``handler`` execute the commands that the sink passes on, until cancelled."""
        async with MessageTasks() as tasks:
            self._receiving = _Receiving(handler, tasks, asyncio.get_running_loop())
            self._copy_status(handler)
            try:
                await asyncio.Future()
            finally:
                self._receiving = None

    def _copy_status(self, handler: CommandMessageHandler) -> None:
        """Copy the state of the sink's connection into the status of the handler, and log a new error."""
        error = self._error
        if error is None:
            handler.connected()
        else:
            handler.down(error)

    def _message(self, command: SparkplugCommand) -> InputMessage:
        """Convert a Sparkplug command that has just arrived to the form that all protocols share (rules 1 and 2)."""
        return InputMessage(
            PLACE.replace("{device}", command.device).replace("{point}", command.point),
            json.dumps({"value": command.value}).encode(),
            seconds_left=None if command.sent is None else command.sent + self.rights.seconds - self._now(),
            is_retained=command.is_retained,
            arrived=time.monotonic(),
        )
