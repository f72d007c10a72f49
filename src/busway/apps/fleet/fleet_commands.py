"""Commands to a fleet by NATS request and reply, on a subject of the link: the collector that owns it executes them.

Knows subjects, the collector and the table of results; which request a command is, its rules and the wire are the
collector's own. Works with nats-server 2.9.

1. A command is a request on ``busway.<zone>.command.<link>``: JSON with key, device, point, value, by and expires. Only
   the link's owner listens there, so a link without an owner answers nothing and nothing is sent.
2. Before the wire the result key is created in the table of results by compare-and-set: of two collectors that get
   one command, one executes it. What is found there finished is the answer; found unfinished it is unknown. A key that
   was created is never sent again, by a later owner of the link either.
3. A table that does not answer refuses the command: nothing is sent.
4. The end is in the table before it is told, unless that is away: then it is told, and asked for again it is unknown.
5. Each end is a message of the stream of audit lines, ``busway.<zone>.audit``, too. Rights are those of subjects: who
   may send on a link's subject is the server's decision, and ``by`` is what the sender says of itself.
"""

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Callable, Iterable
from importlib import import_module
from types import TracebackType
from typing import Any, Final, Self

from ...errors import InvalidRequest
from ..collector.commands.audit import command_line
from ..collector.commands.command import USUAL_SECONDS, CommandResult, CommandState, PointCommand, same_value
from ..collector.commands.message_tasks import MessageTasks
from ..collector.sinks.nats import subject_token
from .control_entries import read_entries
from .coordinator import Coordinator, CoordinatorDown, OutcomeUnknown, RevisionConflict
from .coordinators.opening import until_up
from .fleet_collector import FleetCollector
from .lease_driver import end_tasks
from .outbox import StreamDown
from .streams import found_or_made

RESULTS: Final = "command."
LONGEST_REQUEST: Final = 64 * 1024
RECORD_AGAIN: Final = (0.0, 0.5, 2.0)
"""Seconds before each try to write the end of a command into the table."""
START_SECONDS: Final = 30.0
"""Seconds for which a server that does not answer is asked for the stream of audit lines."""
AUDIT_AGE: Final = 366 * 86_400.0
_ESCAPED: Final = {"_": "__", ":": "_c", "@": "_a", ".": "_d"}
"""Characters of keys that names of entries may not have, or not everywhere."""
_KEYS: Final = {"key", "device", "point", "value", "by", "expires"}
_log = logging.getLogger("busway.fleet")


def command_subject(zone: str, link: str) -> str:
    """Return the subject on which the owner of a link takes commands."""
    return f"busway.{zone}.command.{subject_token(link)}"


def result_key(key: str) -> str:
    """Return the name of a command's entry in the table of results."""
    return RESULTS + "".join(_ESCAPED.get(each, each) for each in key)


def _ignore_step(name: str) -> None:
    """Do nothing between two steps of a command; tests replace this to end the process there."""


class FleetCommands:
    """Takes commands for the links that a collector of a fleet owns, while the ``async with`` block lasts.

    Args:
        fleet: the running collector.
        client: of nats-py, connected.
        results: the table of results, which all collectors of the zone share.
        zone: its name.
        replicas: servers that keep each line of the audit.
        now: seconds since 1970 UTC.
        step: is told the name of each step that a command has taken: ``created``, ``answered``, ``recorded``.
    """

    def __init__(
        self,
        fleet: FleetCollector,
        client: Any,  # of nats-py, which has no types here
        results: Coordinator,
        zone: str,
        *,
        replicas: int = 1,
        now: Callable[[], float] = time.time,
        step: Callable[[str], None] = _ignore_step,
    ) -> None:
        self._fleet, self._client, self._results, self._zone = fleet, client, results, zone
        self._replicas, self._now, self._step = replicas, now, step
        self._messages = MessageTasks()
        self._running: dict[str, tuple[PointCommand, asyncio.Task[dict[str, Any]]]] = {}
        self._subscribed: dict[str, Any] = {}
        self._changed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Begin to listen on the subjects of owned links. Raises `ConfigError`, `StreamDown`: no stream for audits."""
        await self._make_audit_stream()
        await self._messages.__aenter__()
        self._fleet.follow_links(self._changed.set)
        self._changed.set()
        self._task = asyncio.create_task(self._follow(), name="busway fleet commands")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Take no more commands, and wait until those that run are recorded."""
        assert self._task is not None
        await end_tasks([self._task])
        await self._listen(())
        await asyncio.gather(*(task for _, task in self._running.values()), return_exceptions=True)
        await self._messages.__aexit__(kind, error, trace)

    async def _make_audit_stream(self) -> None:
        api = import_module("nats.js.api")
        config = api.StreamConfig(
            name=f"busway-audit-{self._zone}",
            subjects=[f"busway.{self._zone}.audit"],
            storage=api.StorageType.FILE,
            num_replicas=self._replicas,
            max_age=AUDIT_AGE,
        )
        await until_up(lambda: found_or_made(self._client, config), StreamDown, START_SECONDS)

    async def _follow(self) -> None:
        while True:
            await self._changed.wait()
            self._changed.clear()
            await self._listen(self._fleet.links)

    async def _listen(self, links: Iterable[str]) -> None:
        """Listen on the subjects of these links alone."""
        errors = import_module("nats.errors")
        wanted = {command_subject(self._zone, link) for link in links}
        for subject in self._subscribed.keys() - wanted:
            with contextlib.suppress(errors.Error, OSError):
                await self._subscribed.pop(subject).unsubscribe()
        for subject in wanted - self._subscribed.keys():
            with contextlib.suppress(errors.Error, OSError):
                self._subscribed[subject] = await self._client.subscribe(subject, cb=self._came)

    async def _came(self, message: Any) -> None:
        if not self._messages.begin(lambda: self._handle(message)):
            _log.warning("a command on %s is dropped: too many wait", message.subject)

    async def _handle(self, message: Any) -> None:
        answer = await self.take(message.subject, message.data)
        if message.reply:
            with contextlib.suppress(import_module("nats.errors").Error, OSError):
                await message.respond(json.dumps(answer).encode())

    async def take(self, subject: str, data: bytes) -> dict[str, Any]:
        """Execute the command in a request; returns the answer, errors too."""
        try:
            command = self._parsed(data)
            device = self._fleet.collector.configuration.devices.get(command.device)
            if device is None or command_subject(self._zone, device.link) != subject:
                raise InvalidRequest(f"{command.device} is not a device of this link here; nothing was sent")
            running = self._running.get(command.key)
            if running is not None and running[0].is_same(command):
                return await asyncio.shield(running[1])
            task = asyncio.create_task(self._take(command))
            self._running[command.key] = command, task
            task.add_done_callback(lambda _: self._running.pop(command.key, None))
            return await asyncio.shield(task)
        except InvalidRequest as error:
            return {"state": CommandState.REFUSED.value, "reason": error.message}

    def _parsed(self, data: bytes) -> PointCommand:
        try:
            given = json.loads(data) if len(data) <= LONGEST_REQUEST else None
        except (ValueError, RecursionError) as error:
            raise InvalidRequest(f"a command is a JSON object: {error}") from error
        if not isinstance(given, dict) or not _KEYS - {"by", "expires"} <= given.keys() <= _KEYS:
            raise InvalidRequest(
                "a command is a JSON object of key, device, point, value and, if wanted, by and expires"
            )
        return PointCommand(
            given["key"],
            given["device"],
            given["point"],
            given["value"],
            given.get("by", "fleet"),
            "fleet",
            given.get("expires", self._now() + USUAL_SECONDS),
        )

    async def _take(self, command: PointCommand) -> dict[str, Any]:
        """Take the key of a command, execute it, and record its end (rules 2, 3 and 4)."""
        key = result_key(command.key)
        opened = {**_about(command), "state": CommandState.OPEN.value, "collector": self._fleet.member.name}
        try:
            revision = await self._results.create(key, _encoded(opened))
        except RevisionConflict:
            return await self._of_first(key, command)
        except (CoordinatorDown, OutcomeUnknown) as error:
            raise InvalidRequest(f"the table of results does not answer, nothing was sent: {error}") from error
        self._step("created")
        try:
            result = await self._fleet.collector.commands.write(
                command.device,
                command.point,
                command.value,
                by=command.by,
                origin=command.origin,
                expires=command.expires,
                key=command.key,
            )
            ended = {**opened, **result.content()}
        except InvalidRequest as error:  # nothing was sent
            result = CommandResult(command, CommandState.OPEN, self._now())
            result = result.finished(CommandState.REFUSED, error.message)
            ended = {**opened, **result.content()}
        self._step("answered")
        await self._record(key, ended, revision)
        self._step("recorded")
        await self._publish_audit(result)
        return ended

    async def _of_first(self, key: str, command: PointCommand) -> dict[str, Any]:
        """Return the answer for a key that was used before: its end, or that nothing says what became of it."""
        try:
            async with asyncio.timeout(5.0):
                entry = (await read_entries(self._results, key)).get(key)
            known: dict[str, Any] = json.loads(entry.value) if entry is not None else {}
        except (TimeoutError, ValueError):
            known = {}
        if not known:
            return {**_about(command), "state": CommandState.UNKNOWN.value, "reason": "its result cannot be read now"}
        if (known["device"], known["point"]) != (command.device, command.point) or not same_value(
            known["value"], command.value
        ):
            raise InvalidRequest(f"this key was used for another command, {known['device']}/{known['point']}")
        if known["state"] == CommandState.OPEN.value:
            reason = f"{known['collector']} has begun it, and nothing says what became of it; it is not sent again"
            return {**known, "state": CommandState.UNKNOWN.value, "reason": reason}
        return known

    async def _record(self, key: str, ended: dict[str, Any], revision: int) -> None:
        for pause in RECORD_AGAIN:
            await asyncio.sleep(pause)
            try:
                await self._results.replace(key, _encoded(ended), revision)
                return
            except RevisionConflict:
                return  # a try before, whose answer was lost
            except (CoordinatorDown, OutcomeUnknown) as error:
                _log.warning("the end of command %s is not recorded yet: %s", ended["key"], error)

    async def _publish_audit(self, result: CommandResult) -> None:
        nats = import_module("nats")
        line = command_line(result, time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self._now())))
        try:
            await self._client.jetstream(timeout=5.0).publish(
                f"busway.{self._zone}.audit", line.encode(), headers={"Nats-Msg-Id": result.command.key}
            )
        except (nats.errors.Error, OSError, TimeoutError) as error:
            _log.warning(
                "the line of command %s is in the audit log of %s alone: %s",
                result.command.key,
                self._fleet.member.name,
                error or type(error).__name__,
            )


def _about(command: PointCommand) -> dict[str, Any]:
    return {
        "key": command.key,
        "device": command.device,
        "point": command.point,
        "value": command.value,
        "by": command.by,
        "reason": None,
    }


def _encoded(content: dict[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":")).encode()
