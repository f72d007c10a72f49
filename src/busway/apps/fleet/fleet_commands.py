"""Commands to a fleet by NATS request and reply, on a subject of the link: the collector that owns it executes them.

Knows subjects and the collector, and how another program sends a command (`send_command`). The collector itself checks
a command and its key, and makes it a Modbus request. Works with nats-server 2.9.

1. A command is a request on ``busway.<zone>.command.<link>``: JSON with key, device, point, value, by, expires and
   role. Only the link's owner listens there, so a link without an owner answers nothing and nothing is sent.
2. The key of the command is taken for the whole zone, as for any write by a collector of a fleet (`key_table`).
3. When a command of this collector ends, no matter how it came, a message about it is also sent to the stream of audit
   lines, ``busway.<zone>.audit``.
4. A command that reached a collector by MQTT or NATS, for a link that another collector owns, is passed on to the owner
   by such a request.
5. The server decides who may send on the subject of a link; ``by`` is what the sender says of itself. A sender has the
   role ``configure``, like any program, unless the request names a lower role: a collector that passes on a command
   names the role of the original sender. A point whose commands must be armed cannot be written this way, because
   there is one step only.
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

from ...errors import ConfigError, InvalidRequest, LinkDown, WriteOutcomeUnknown
from ...values.unfit_values import shown
from ..collector.cancellation import end_tasks
from ..collector.commands.audit import command_line
from ..collector.commands.command import USUAL_SECONDS, CommandResult, CommandState, PointCommand
from ..collector.commands.message_tasks import MessageTasks
from ..collector.commands.rights import WriterRights
from ..collector.sinks.nats import subject_token
from ..collector.task_errors import log_defect
from .coordinators.nats import asked
from .fleet_collector import FleetCollector
from .streams import make_audit_stream

LONGEST_REQUEST: Final = 64 * 1024
START_SECONDS: Final = 30.0
"""Seconds for which it is tried at the start to find or create the stream of audit lines, if no server answers."""
LISTEN_AGAIN: Final = 5.0
"""Seconds after which subscribing is tried again after a defect."""
LONGEST_WAIT: Final = 60.0
ANSWER_SECONDS: Final = 15.0
"""Seconds to wait for an answer beyond the expiry of a command that was passed on: the owner may write just before the
expiry, and then reads the value back before it answers."""
_KEYS: Final = {"key", "device", "point", "value", "by", "expires", "role"}
_MAY_BE_LEFT_OUT: Final = {"by", "expires", "role"}
_ROLES: Final = ("operate", "configure")
_log = logging.getLogger("busway.fleet")


def command_subject(zone: str, link: str) -> str:
    """Return the NATS subject on which the owner of a link takes commands: ``busway.<zone>.command.<link>``."""
    return f"busway.{zone}.command.{subject_token(link)}"


async def send_command(client: Any, zone: str, link: str, content: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Ask the collector that owns a link to write a value to a point, at most once for each key; return its answer.

    Args:
        client: connected client of `connect_nats`.
        zone, link: names of the zone and the link.
        content: the command: ``key``, ``device``, ``point`` and ``value``, and if wanted ``by``, ``expires`` (seconds
            since 1970 UTC) and ``role`` (``operate`` or ``configure``).
        seconds: seconds to wait for the answer.

    Returns:
        The answer: ``state`` and ``reason``, and further keys of `CommandResult.content`.

    Raises:
        LinkDown: no collector owns the link now, or there is no connection; nothing was sent to the device.
        ConfigError: the credentials do not permit commands; nothing was sent to the device.
        WriteOutcomeUnknown: no answer came, or one that cannot be read. The same command with the same key may be sent
            again: the value is written once.
    """
    errors = import_module("nats.errors")
    subject = command_subject(zone, link)
    if not client.is_connected:
        raise LinkDown("the connection to the coordinator is lost; nothing was sent", kind="lost")
    try:
        reply = await asked(client, subject, client.request(subject, json.dumps(content).encode(), timeout=seconds))
        answer = json.loads(reply.data)
    except errors.NoRespondersError as error:
        raise LinkDown(f"no collector of zone {zone} owns link {link} now; nothing was sent", kind="other") from error
    except (errors.Error, OSError, TimeoutError, ValueError) as error:
        if subject in client.cause and "permissions" in client.cause.lower():
            raise ConfigError(f"the credentials do not permit commands: {client.cause}", key="coordinator") from error
        raise WriteOutcomeUnknown(f"no answer to command {content['key']} came: {str(error) or 'in time'}") from error
    if not isinstance(answer, dict) or answer.get("state") not in set(CommandState):
        raise WriteOutcomeUnknown(f"the answer to command {content['key']} is none")
    return answer


class FleetCommands:
    """Takes commands by NATS for the links that a collector of a fleet owns, while the ``async with`` block lasts.

    It also passes on commands for links of other collectors to their owners, and publishes the audit line of each
    command.

    Args:
        fleet: the running collector.
        client: connected client of `connect_nats`.
        zone: name of the zone.
        replicas: number of servers that keep each audit line, if the stream for them is created.
        now: returns the time in seconds since 1970 UTC.
    """

    def __init__(
        self,
        fleet: FleetCollector,
        client: Any,  # of nats-py, which has no types here
        zone: str,
        *,
        replicas: int = 1,
        now: Callable[[], float] = time.time,
    ) -> None:
        self._fleet, self._client, self._zone = fleet, client, zone
        self._replicas, self._now = replicas, now
        self._messages = MessageTasks()
        self._publishing: set[asyncio.Task[None]] = set()
        self._has_ended = False
        self._subscribed: dict[str, Any] = {}
        self._changed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Begin to listen on the subjects of owned links, and to pass on commands.

        The stream for audit lines is found or created first.

        Raises:
            ConfigError: the stream for audit lines cannot be created or used.
            StreamDown: no server has answered for `START_SECONDS`.
        """
        await make_audit_stream(self._client, self._zone, self._replicas, start=START_SECONDS)
        await self._messages.__aenter__()
        self._fleet.follow_links(self._changed.set)
        self._fleet.pass_on = self._pass_on
        self._fleet.collector.commands.subscribe(self._told)
        self._changed.set()
        self._task = asyncio.create_task(self._follow(), name="busway fleet commands")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Take no more commands, and wait until the audit lines of the commands that have ended are sent.

        Commands in progress are completed by the collector, but their answers and audit lines are not sent.
        """
        assert self._task is not None
        self._fleet.pass_on = None
        await end_tasks([self._task])
        await self._listen(())
        await self._messages.__aexit__(kind, error, trace)
        self._has_ended = True
        await asyncio.gather(*self._publishing, return_exceptions=True)  # `log_defect` has logged them

    async def _follow(self) -> None:
        while True:
            await self._changed.wait()
            self._changed.clear()
            try:
                await self._listen(self._fleet.links)
            except Exception:  # a defect of a client library: else commands for links that come later would be lost
                _log.exception("not all links of this collector take commands; it is tried again")
                await asyncio.sleep(LISTEN_AGAIN)
                self._changed.set()

    async def _listen(self, links: Iterable[str]) -> None:
        """Subscribe to the subjects of these links, and unsubscribe from the subjects of all other links."""
        errors = import_module("nats.errors")
        wanted = {command_subject(self._zone, link) for link in links}
        for subject in self._subscribed.keys() - wanted:
            with contextlib.suppress(errors.Error, OSError):
                await self._subscribed.pop(subject).unsubscribe()
        for subject in wanted - self._subscribed.keys():
            with contextlib.suppress(errors.Error, OSError):
                self._subscribed[subject] = await self._client.subscribe(subject, cb=self._came)

    async def _pass_on(self, link: str, command: PointCommand, role: str) -> dict[str, Any]:
        """Ask the owner of a link to execute a command, and return its answer; a failure is returned as an answer too.

        A missing answer is returned with the state ``unknown``, any other failure with the state ``refused``.
        """
        left = max(0.0, command.expires - self._now())
        content = {"key": command.key, "device": command.device, "point": command.point, "value": command.value}
        content |= {"by": command.by, "expires": command.expires, "role": role}
        try:
            return await send_command(self._client, self._zone, link, content, min(left, LONGEST_WAIT) + ANSWER_SECONDS)
        except WriteOutcomeUnknown as error:
            return {"key": command.key, "state": CommandState.UNKNOWN.value, "reason": error.message}
        except (LinkDown, ConfigError) as error:
            return {"key": command.key, "state": CommandState.REFUSED.value, "reason": error.message}

    async def _came(self, message: Any) -> None:
        if not self._messages.begin(lambda: self._handle(message)):
            _log.warning("a command on %s is dropped: too many wait", message.subject)

    async def _handle(self, message: Any) -> None:
        answer = await self.take(message.subject, message.data)
        if message.reply:
            with contextlib.suppress(import_module("nats.errors").Error, OSError):
                await message.respond(json.dumps(answer).encode())

    async def take(self, subject: str, data: bytes) -> dict[str, Any]:
        """Execute the command that a request holds, and return the answer to it, as `send_command` describes it.

        A request that is not a valid command for a link of this collector is answered with the state ``refused``.

        Args:
            subject: subject of the request.
            data: the command in JSON (rule 1).
        """
        try:
            command, rights = self._parsed(data)
            device = self._fleet.collector.configuration.devices.get(command.device)
            if device is None or command_subject(self._zone, device.link) != subject:
                raise InvalidRequest(f"{command.device} is not a device of this link here; nothing was sent")
            result = await self._fleet.collector.commands.write(
                command.device,
                command.point,
                command.value,
                by=command.by,
                origin=command.origin,
                expires=command.expires,
                key=command.key,
                rights=rights,
            )
            return result.content()
        except InvalidRequest as error:
            return {"state": CommandState.REFUSED.value, "reason": error.message}

    def _parsed(self, data: bytes) -> tuple[PointCommand, WriterRights]:
        try:
            given = json.loads(data) if len(data) <= LONGEST_REQUEST else None
        except (ValueError, RecursionError) as error:
            raise InvalidRequest(f"a command is a JSON object: {error}") from error
        if not isinstance(given, dict) or not _KEYS - _MAY_BE_LEFT_OUT <= given.keys() <= _KEYS:
            raise InvalidRequest(
                "a command is a JSON object of key, device, point, value and, if wanted, by, expires and role"
            )
        role = given.get("role", "configure")
        if role not in _ROLES:
            raise InvalidRequest(f"role is {' or '.join(_ROLES)}, not {shown(role)}")
        command = PointCommand(
            given["key"],
            given["device"],
            given["point"],
            given["value"],
            given.get("by", "fleet"),
            "fleet",
            given.get("expires", self._now() + USUAL_SECONDS),
        )
        return command, WriterRights(role)

    def _told(self, result: CommandResult) -> None:
        """Start a task that publishes the audit line of a command; the collector calls this for each command that ends.

        Does nothing after the ``async with`` block has ended.
        """
        if not self._has_ended:
            task = asyncio.create_task(self._publish_audit(result), name="busway fleet audit")
            self._publishing.add(task)
            task.add_done_callback(log_defect)
            task.add_done_callback(self._publishing.discard)

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
                str(error) or type(error).__name__,
            )
