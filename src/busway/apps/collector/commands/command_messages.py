"""Commands that arrive as messages (MQTT, NATS, Sparkplug): which points they may write, how they are answered.

Knows messages and the runner of commands; knows no broker.

1. Nothing is taken unless the file names where commands come from, the points that they may write, and their role.
   Brokers do not say who sends, so all messages of one server have the same role; `rights` decides what that permits.
2. A message is JSON: the value alone, or ``{"value": 21.5, "key": "…", "expires": 1800000000, "by": "…"}``. A message
   that is not JSON is a text: the name of a number. A command without ``expires`` may be sent within
   `InputRights.seconds`. With ``"arm": true`` it is checked and armed, and is sent when ``{"confirm": "KEY"}`` comes on
   the same topic within a minute.
3. A retained message is refused: a broker would hand it on again at every connection.
4. The topic of a command must stand for one point. Some characters of names are replaced in topics, so one topic can
   stand for two points of the plant; then neither is written, even if the file permits only one of them.
5. In a fleet the owner of a link executes the commands for its devices. If the server gives each message to only one
   collector, that one passes it on to the owner. If messages go to all collectors, only the owner answers; for a link
   without an owner one collector answers with an error. A message to all may reach a new owner late, when the owner
   before has executed it already: so a command without a key is refused until a link has been here for
   `SECONDS_AFTER_CHANGE_OF_OWNER`.
6. The seconds in which a command may be sent count from the arrival of its message, also while it waits for others.
"""

import json
import logging
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Protocol

from ....errors import InvalidRequest, ModbusError, Overloaded
from ....log_limiter import LogLimiter, suppressed_note
from ....points.name_patterns import is_meant
from ....points.point import Point
from ....points.point_rules import WriteRule
from ....values.unfit_values import shown
from .command import CommandResult, CommandState, PointCommand, new_key
from .other_owners import OtherOwners
from .rights import WriterRights
from .runner import CommandRunner

LONGEST_REQUEST: Final = 16_384
"""Most bytes of a message with a command."""
PAUSE: Final = 0.5
PAUSE_LIMIT: Final = 30.0
SECONDS_AFTER_CHANGE_OF_OWNER: Final = 30.0
"""Seconds after a change of a link's owner in which a message may arrive that the earlier owner has executed."""
_LONGEST_NAME: Final = 100
_KNOWN: Final = frozenset({"value", "key", "expires", "by"})
_TWO_STEPS: Final = ({"value", "arm", "by"}, {"confirm", "by"})
"""The keys of a message that arms a command, and of one that confirms it; ``by`` can be missing."""

_log = logging.getLogger("busway.collector.commands")


@dataclass(frozen=True, slots=True)
class InputRights:
    """The points that commands from one server may write, and the topics on which these commands come.

    Attributes:
        where: topic or subject of commands, with ``{device}`` and ``{point}`` as levels of their own.
        points: patterns ``device/point`` of the points that may be written.
        seconds: seconds from its arrival within which a command without an expiry may be sent.
        role: the role of all commands from this server: ``view``, ``operate`` or ``configure``.
    """

    where: str
    points: tuple[str, ...]
    seconds: float = 10.0
    role: str = "operate"

    def permits(self, device: str, point: str) -> bool:
        """Whether the patterns permit commands to write a point, apart from the point's own rule for writing.

        The device is matched with the part of a pattern before the first ``/``, the point with the rest.
        """
        for pattern in self.points:
            devices, _, points = pattern.partition("/")
            if is_meant(device, devices) and is_meant(point, points):
                return True
        return False


@dataclass(frozen=True, slots=True)
class InputMessage:
    """A message that carries a write command, in a form that MQTT, NATS and Sparkplug share.

    Attributes:
        where: its topic or subject.
        payload: its content.
        by: name of the sender, as a header or property of the message says; empty if none says.
        seconds_left: seconds from its arrival until it expires; None if the message has no expiry of its own.
        is_retained: whether it was published with the retain flag, so that a broker keeps it for later subscribers.
        arrived: when it arrived, seconds of the monotonic clock; None if it arrives now.
    """

    where: str
    payload: bytes
    by: str = ""
    seconds_left: float | None = None
    is_retained: bool = False
    arrived: float | None = None


@dataclass(frozen=True, slots=True)
class InputStatus:
    """The status of one server that commands come from, such as an MQTT broker.

    Attributes:
        name: the name of the sink whose table asks for its commands.
        taken: number of messages received since the start, also those that another collector of the fleet answers.
        refused: number of messages that were refused here: dropped, retained, not understood, not permitted, not to be
            armed or confirmed, or for a link without an owner or with a new one (rule 5). A command whose result is a
            refusal by the runner is not counted.
        error: why it is not connected; None while it is connected.
    """

    name: str
    taken: int
    refused: int
    error: str | None


class DescribedDevice(Protocol):
    """Interface of a device of a collector's configuration, as commands need it."""

    @property
    def name(self) -> str:
        """Name of the device in the collector's configuration."""

    @property
    def points(self) -> Sequence[Point]:
        """All points of the device that the configuration declares."""


class DescribedPlant(Protocol):
    """Interface of a collector's configuration as commands see it: its devices with their points."""

    @property
    def devices(self) -> Mapping[str, DescribedDevice]:
        """The devices of the configuration, by name."""


class CommandInput(Protocol):
    """Interface of a receiver that gets commands as messages from one server, such as an MQTT broker.

    Attributes:
        kind: the protocol, as the origin of its commands: ``mqtt``, ``nats`` or ``sparkplug``.
        rights: the points that its commands may write.
        separator: the character between two levels of a topic or subject.
    """

    kind: str
    rights: InputRights
    separator: str

    def level(self, name: str) -> str:
        """Return a device or point name as one level of a topic or subject; forbidden characters are replaced."""

    def join(self, group: str, member: str) -> bool:
        """Receive as one of the collectors of a fleet; called before `run`.

        Args:
            group: the name under which the collectors share messages; empty if each collector gets all of them.
            member: the name of this collector.

        Returns:
            True if the server gives each message to one collector only; False if every collector gets it.
        """

    async def run(self, handler: "CommandMessageHandler") -> None:
        """Receive messages, pass each to `CommandMessageHandler.handle` and send the answer, until cancelled.

        A lost connection is opened again after pauses.
        """


class CommandMessageHandler:
    """Turns the messages from one server into commands, has them executed, and returns the answers.

    In a fleet, creating it makes ``made`` join the group of the collectors (`CommandInput.join`).

    Args:
        name: the name of the sink whose table asks for the commands; ``by`` of each command begins with it.
        made: receives the messages from the server.
        runner: executes the commands.
        configuration: returns the present configuration.
        plant: returns the configuration of a whole fleet, of which ``configuration`` is the part that this collector
            polls now; None for a collector that works alone.
        others: the other collectors of the fleet (rule 5); None for a collector that works alone.
        now: returns seconds since 1970 UTC.
        moment: returns seconds of the monotonic clock.
    """

    def __init__(
        self,
        name: str,
        made: CommandInput,
        runner: CommandRunner,
        configuration: Callable[[], "DescribedPlant"],
        *,
        plant: Callable[[], "DescribedPlant"] | None = None,
        others: OtherOwners | None = None,
        now: Callable[[], float] = time.time,
        moment: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name, self._input, self._runner = name, made, runner
        self._configuration, self._now, self._moment = configuration, now, moment
        self._plant = plant or configuration
        self._others = others
        self._is_shared = others is not None and made.join(others.group, others.member)
        self._places: tuple[DescribedPlant, dict[str, tuple[str, str] | None]] | None = None
        self._taken = self._refused = 0
        self._error: str | None = "not connected yet"
        self._log_limiter = LogLimiter()

    def status(self) -> InputStatus:
        """Return the status of the server that commands come from: its connection, and counts of messages."""
        return InputStatus(self._name, self._taken, self._refused, self._error)

    async def run(self) -> None:
        """Receive and execute commands of one server until cancelled; connect again after pauses."""
        await self._input.run(self)

    def connected(self) -> None:
        """Show in the status that the connection to the server is open; called by the receiver of messages."""
        self._error = None

    def down(self, error: str) -> None:
        """Show in the status why there is no connection to the server; a new reason is logged.

        Called by the receiver of messages.
        """
        if self._error != error:
            _log.warning("commands of %s: %s", self._name, error)
        self._error = error

    def is_for_commands(self, where: str) -> bool:
        """Whether a topic or subject can be one on which commands arrive; no answer must be sent there."""
        return overlap(self._input.rights.where, where, self._input.separator)

    def drop(self, where: str) -> None:
        """Count a message that was dropped, because too many wait, as received and refused, and log it.

        Args:
            where: its topic or subject.
        """
        self._taken += 1
        self._refuse(where, "too many messages wait")

    async def handle(self, message: InputMessage) -> bytes | None:
        """Execute the command in a message, or arm, confirm or pass it on, and return the answer.

        Args:
            message: the message.

        Returns:
            The answer as JSON: the result of the command (`CommandResult.content`), or why it is refused; for an armed
                command its key, its expiry and the question to confirm. None if this collector does not answer: the
                device is not its own, or another collector of the fleet answers.
        """
        self._taken += 1
        device = None
        try:
            device, point = self._place(message.where)
            if self._others is None and device not in self._configuration().devices:
                return None
            given = parsed(message.payload)
            is_in_two_steps = "arm" in given or "confirm" in given
            command = self._command(message, {"value": "", **given} if is_in_two_steps else given, device, point)
        except InvalidRequest as error:
            return self._refuse(message.where, error.message) if await self._answers(device) else None
        # Not later: who owned the link when the message came may have sent it.
        arrived = self._moment() if message.arrived is None else message.arrived
        since = None if self._others is None else self._others.owned_since(device)
        if not await self._answers(device):
            return None
        if message.is_retained:
            refused = CommandResult(command, CommandState.OPEN, self._now())
            self._refused += 1
            return _encoded(
                self._runner.refused(
                    refused, "retained commands are not executed: the broker would send them again"
                ).content()
            )
        rights = WriterRights(self._input.rights.role)
        if is_in_two_steps:
            return await self._in_two_steps(message.where, given, command, rights)
        if self._others is not None and since is None:
            refusal = rights.refusal(self._rule(command))
            if refusal:
                return self._refuse(message.where, f"{device}/{point} {refusal}")
            if not self._is_shared:
                return self._refuse(message.where, f"no collector owns the link of {device} now; nothing was sent")
            if "key" not in given:
                command = replace(command, key=f"write-{secrets.token_hex(12)}")
            return _encoded(await self._others.pass_on(command, rights.role))
        if (
            since is not None
            and not self._is_shared
            and "key" not in given
            and arrived - since < SECONDS_AFTER_CHANGE_OF_OWNER
        ):
            reason = "its owner before may have executed this; send it with a key, or later"
            left = since + SECONDS_AFTER_CHANGE_OF_OWNER - arrived
            return self._refuse(message.where, f"the link of {device} came here just now, and {reason} ({left:.0f} s)")
        try:
            result = await self._runner.write(
                command.device,
                command.point,
                command.value,
                by=command.by,
                origin=command.origin,
                expires=command.expires,
                key=given.get("key"),
                rights=rights,
            )
        except InvalidRequest as error:
            return self._refuse(message.where, error.message)
        return _encoded(result.content())

    async def _in_two_steps(
        self, where: str, given: dict[str, Any], command: PointCommand, rights: WriterRights
    ) -> bytes:
        """Arm a command, or confirm one, and return the answer.

        Args:
            where: topic or subject of the message.
            given: the keys and values of the message, with ``arm`` or ``confirm``.
            command: the command; for ``confirm`` only its device, point, sender and expiry are used.
            rights: what messages from this server may do.

        Returns:
            The answer as JSON; an error of arming or confirming is a refusal in it, and not raised.
        """
        runner, left = self._runner, command.expires - self._now()
        try:
            if "confirm" in given:
                result = await runner.confirm(
                    given["confirm"],
                    by=command.by,
                    origin=command.origin,
                    point=(command.device, command.point),
                    seconds=left,
                    rights=rights,
                )
                return _encoded(result.content())
            if left <= 0:
                raise InvalidRequest("its time was over; nothing is armed")
            armed = runner.arm(
                command.device, command.point, command.value, by=command.by, origin=command.origin, rights=rights
            )
        except (InvalidRequest, Overloaded, OSError) as error:
            return self._refuse(where, error.message if isinstance(error, ModbusError) else str(error))
        content = {"state": "armed", "key": armed.command.key, "confirm": armed.sentence}
        return _encoded(content | {"expires": armed.command.expires})

    def _rule(self, command: PointCommand) -> WriteRule | None:
        points = self._plant().devices[command.device].points
        return next((each.writing for each in points if each.name == command.point), None)

    async def _answers(self, device: str | None) -> bool:
        """Return whether this collector answers a message for a device (rule 5).

        Args:
            device: name of the device; None for a message that names none.
        """
        return self._others is None or self._is_shared or await self._others.answers(device)

    def _command(self, message: InputMessage, given: dict[str, Any], device: str, point: str) -> PointCommand:
        now = self._now()
        arrived = now if message.arrived is None else now - (self._moment() - message.arrived)
        expires = given.get("expires", arrived + self._input.rights.seconds)
        if message.seconds_left is not None and isinstance(expires, int | float):
            expires = min(expires, arrived + message.seconds_left)
        said = given.get("by", message.by)
        if not isinstance(said, str):
            raise InvalidRequest(f"by is a text, not {shown(said)}")
        if len(said) > _LONGEST_NAME and given.keys() & {"arm", "confirm"}:  # two that are cut may seem one
            raise InvalidRequest(f"by has at most {_LONGEST_NAME} characters in a command in two steps")
        name = f"{self._name}: {said[:_LONGEST_NAME]}" if said else self._name
        key = given.get("key", new_key(now))
        return PointCommand(key, device, point, given["value"], name, self._input.kind, expires)

    def _place(self, where: str) -> tuple[str, str]:
        """Return the device and the point that a topic or subject stands for.

        Raises:
            InvalidRequest: the topic stands for no point that commands from this server may write, or for several.
        """
        plant = self._plant()
        if self._places is None or self._places[0] is not plant:
            self._places = plant, self._places_of(plant)
        found = self._places[1].get(where, ())
        if not found:
            why = "stands for more than one point" if found is None else "is no point that may be written from here"
            raise InvalidRequest(f"{shown(where)} {why}")
        return found

    def _places_of(self, plant: DescribedPlant) -> dict[str, tuple[str, str] | None]:
        rights, level = self._input.rights, self._input.level
        found: dict[str, tuple[str, str] | None] = {}
        permitted: set[str] = set()
        for device in plant.devices.values():
            for point in device.points:
                where = rights.where.replace("{device}", level(device.name)).replace("{point}", level(point.name))
                found[where] = None if where in found else (device.name, point.name)
                if point.writing is not None and rights.permits(device.name, point.name):
                    permitted.add(where)
        return {where: place for where, place in found.items() if where in permitted}

    def _refuse(self, where: str, reason: str) -> bytes:
        self._refused += 1
        repeated = self._log_limiter.admit(where[:_LONGEST_NAME], time.monotonic())
        if repeated is not None:
            _log.warning(
                "commands of %s: %s is refused: %s%s", self._name, shown(where), reason, suppressed_note(repeated)
            )
        return _encoded({"state": CommandState.REFUSED.value, "reason": reason})


def parsed(payload: bytes) -> dict[str, Any]:
    """Parse the payload of a message with a command: JSON, or a plain text as the value.

    Returns:
        A dict with the key ``value``, and ``key``, ``expires`` and ``by`` if the message has them. For a command in two
        steps it has ``value`` and ``arm``, or ``confirm`` without ``value``, and ``by`` if the message has it. Types of
        values are not checked.

    Raises:
        InvalidRequest: the message is too long or cannot be parsed, or a key is unknown or missing.
    """
    if len(payload) > LONGEST_REQUEST:
        raise InvalidRequest(f"a command has at most {LONGEST_REQUEST} bytes, not {len(payload)}")
    try:
        text = payload.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InvalidRequest(f"a command is UTF-8; byte {error.start} is not") from error
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        found = text.strip()
        if not found or found[0] in "{[":
            raise InvalidRequest("the message is neither JSON nor a name") from None
    if not isinstance(found, dict):
        return {"value": found}
    if found.keys() & {"arm", "confirm"}:
        if found.keys() - {"by"} not in [keys - {"by"} for keys in _TWO_STEPS] or found.get("arm", True) is not True:
            raise InvalidRequest('a command in two steps is {"value": …, "arm": true}, then {"confirm": "its key"}')
        return found
    unknown = sorted(found.keys() - _KNOWN)
    if unknown:
        raise InvalidRequest(f"unknown key {shown(unknown[0])}; there are value, key, expires and by")
    if "value" not in found:
        raise InvalidRequest("value is missing")
    return found


def overlap(one: str, other: str, separator: str) -> bool:
    """Whether two topic patterns can match the same topic.

    Args:
        one, other: topics or subjects, in which ``{…}`` stands for any one level.
        separator: divides the levels.
    """
    left, right = one.split(separator), other.split(separator)
    return len(left) == len(right) and all(
        a == b or a.startswith("{") or b.startswith("{") for a, b in zip(left, right, strict=True)
    )


def _encoded(content: dict[str, Any]) -> bytes:
    return json.dumps(content, ensure_ascii=False).encode("utf-8", "backslashreplace")
