"""One device whose points have rules of writing, and every way to command it, in this process and without a socket.

The ways are real: the page's API with its access rules, messages as MQTT, NATS and Sparkplug hand them over, requests
to a fleet, and programs. The device, the brokers and the clocks are not.
"""

import asyncio
import contextlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from busway.access.audit_log import AuditLog
from busway.apps.collector.command_targets import CollectedTargets
from busway.apps.collector.commands.command import CommandResult
from busway.apps.collector.commands.command_messages import CommandMessageHandler, InputMessage, InputRights
from busway.apps.collector.commands.journal import CommandJournal
from busway.apps.collector.commands.runner import CommandRunner
from busway.apps.collector.commands.sparkplug import PLACE
from busway.apps.collector.configuration import CollectorConfiguration, parse_collector
from busway.apps.collector.cost import network_cost
from busway.apps.collector.plan_cache import PlanBook
from busway.apps.collector.poller import LinkPoller
from busway.apps.collector.sample_clock import EARLIEST, SampleClock
from busway.apps.collector.schedule import LinkSchedule
from busway.apps.collector.sinks.mqtt import topic_level
from busway.apps.collector.sinks.prometheus import LastValues
from busway.apps.fleet.fleet_commands import FleetCommands, command_subject
from busway.apps.web.application import page_resources
from busway.apps.web.collector_commands import CommandsApi
from busway.apps.web.request_guard import AccessToken, PageAccess, PageAccessRules, Role
from busway.codes import Table
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import WriteSingleRegister
from busway.points import Point, ReadRules
from busway.values import value_type

LEVEL = Point("level", Table.HOLDING_REGISTERS, 99, value_type("uint16"))
FILE = """\
[collector]
store = "data"
[poll_class]
c.period = 3600.0
[[link]]
name = "hall"
url = "tcp://127.0.0.1:1"
[[device]]
name = "boiler"
link = "hall"
unit = 1
profile = "device:logo8"
"""
"""A collector file whose device gets other points (`configuration_of`)."""


@cache
def _parsed() -> CollectorConfiguration:
    return parse_collector(FILE, "plant.toml")


def configuration_of(points: Sequence[Point]) -> CollectorConfiguration:
    """The configuration of a collector whose one device has these points, and `LEVEL`."""
    usual = _parsed()
    boiler = replace(usual.devices["boiler"], points=(*points, LEVEL), rules=ReadRules(), items={"c": (LEVEL,)})
    return replace(usual, devices={"boiler": boiler})


class HandedInput:
    """The input of commands of one sink; the test itself hands each message to its `CommandMessageHandler`."""

    separator: str = "/"

    def __init__(self, kind: str, rights: InputRights) -> None:
        self.kind, self.rights = kind, rights

    def level(self, name: str) -> str:
        return name if self.kind == "sparkplug" else topic_level(name)

    def join(self, group: str, member: str) -> bool:
        return True

    async def run(self, receiver: CommandMessageHandler) -> None:
        """Receive nothing."""


class RecordedRegisters:
    """A device behind a link that notes each register that is written.

    Attributes:
        writes: address and number of each write.
        before_answer: called with each request, before it is answered.
    """

    def __init__(self) -> None:
        self.writes: list[tuple[int, int]] = []
        self.held: dict[int, int] = {}
        self.before_answer: Callable[[Any], None] = lambda request: None

    async def run(self, unit: int, requests: Sequence[Any], call_options: Any) -> list[Any]:
        await asyncio.sleep(0)
        return [self._answer(request) for request in requests]

    def _answer(self, request: Any) -> Any:
        self.before_answer(request)
        if isinstance(request, WriteSingleRegister):
            self.writes.append((request.address, request.value))
            self.held[request.address] = request.value
            return WriteSingleRegister.Reply(request.address, request.value)
        places = range(request.address, request.address + request.count)
        return ReadHoldingRegisters.Reply(b"".join(self.held.get(each, 0).to_bytes(2, "big") for each in places))


class GatedClaims:
    """The keys of a zone, whose table answers when they are released."""

    def __init__(self) -> None:
        self.released = asyncio.Event()
        self.released.set()
        self.waiting = 0
        self._taken: dict[str, CommandResult] = {}

    async def claim(self, result: CommandResult) -> CommandResult | None:
        self.waiting += 1
        try:
            await self.released.wait()
        finally:
            self.waiting -= 1
        known = self._taken.get(result.command.key)
        self._taken.setdefault(result.command.key, result)
        return known

    def known(self, result: CommandResult) -> CommandResult | None:
        return self._taken.get(result.command.key)

    async def finish(self, result: CommandResult) -> None:
        self._taken[result.command.key] = result


class RuledPlant:
    """The device ``boiler`` at the link ``hall``, and all that may command it.

    Attributes:
        now, moment: the wall clock and the monotonic clock; tests set them.
        tokens: of the page: name and role of a caller, by its token. Tests change them.
    """

    def __init__(self, folder: Path, points: Sequence[Point], tokens: dict[str, tuple[str, str]]) -> None:
        self.folder, self.tokens = folder, tokens
        self.now, self.moment = 1_000_000.0, 5000.0
        self.device = RecordedRegisters()
        self.is_paused = False
        self._set_points(points)

    def _set_points(self, points: Sequence[Point]) -> None:
        self.configuration = configuration_of(points)

    async def start(self) -> None:
        self.claims = GatedClaims()
        self._begin_link()
        self.audit = AuditLog(self.folder / "audit.log")
        targets = CollectedTargets(lambda: self.configuration, lambda device: self.poller, LastValues())
        self.commands = CommandRunner(
            targets,
            CommandJournal(self.folder),
            self.audit,
            claims=self.claims,
            now=lambda: self.now,
            moment=lambda: self.moment,
        )
        collector: Any = self
        routes: Any = SimpleNamespace(add_to=CommandsApi(collector).add_to)
        rules = PageAccessRules(tokens=self._access_tokens, without_token=Role.VIEW)
        self._page = PageAccess(page_resources("page", "", [routes]), rules, lambda path: False)
        fleet: Any = SimpleNamespace(collector=self)
        self._fleet = FleetCommands(fleet, None, "hall", now=lambda: self.now)
        self.inputs: dict[str, tuple[str, CommandMessageHandler]] = {}

    def _access_tokens(self) -> tuple[AccessToken, ...]:
        return tuple(AccessToken.of(token, name, Role[role.upper()]) for token, (name, role) in self.tokens.items())

    def _begin_link(self) -> None:
        loop = asyncio.get_running_loop()
        clock = SampleClock(loop.time(), EARLIEST)
        schedule = LinkSchedule(1.0)
        self.poller = LinkPoller("hall", self.device, schedule, clock, _ignore, _ignore, numbered=True, now=loop.time)
        self.poller.add("boiler", 1, PlanBook({"c": [LEVEL]}, ReadRules(), network_cost()), {"c": 3600.0})
        if self.is_paused:
            self.poller.pause("boiler", paused=True)
        self._task = asyncio.create_task(self.poller.run())

    async def reload(self, points: Sequence[Point]) -> None:
        """Use other points, in the order in which a collector does it."""
        self._set_points(points)
        self.poller.finish()
        await self._task
        self._begin_link()

    def maintain(self, begins: bool) -> None:
        """Begin or end maintenance."""
        self.is_paused = begins
        self.poller.pause("boiler", paused=begins)

    def add_input(self, name: str, kind: str, patterns: Sequence[str], role: str) -> None:
        """Take messages of a sink from now on, instead of those that it had before."""
        where = PLACE if kind == "sparkplug" else "plant/{device}/{point}"
        receiver = CommandMessageHandler(
            name,
            HandedInput(kind, InputRights(where, tuple(patterns), 10.0, role)),
            self.commands,
            lambda: self.configuration,
            now=lambda: self.now,
            moment=lambda: self.moment,
        )
        self.inputs[name] = where, receiver

    async def stop(self) -> None:
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task
        await self.commands.close()
        self.audit.close()

    # The ways.

    async def page(self, token: str, path: str, body: Any = None) -> tuple[int, Any]:
        """Status and content of the answer of the page's API to a POST; an empty token shows none."""
        content = b"" if body is None else json.dumps(body).encode()
        headers = [(b"host", b"127.0.0.1"), (b"content-type", b"application/json")]
        headers += [(b"content-length", str(len(content)).encode())]
        headers += [(b"authorization", f"Bearer {token}".encode())] if token else []
        where = f"/api/commands{path}"
        scope: dict[str, Any] = {"type": "http", "http_version": "1.1", "method": "POST", "path": where}
        scope |= {"raw_path": where.encode(), "query_string": b"", "root_path": "", "scheme": "http", "state": {}}
        scope |= {"headers": headers, "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 80)}
        sent: list[Any] = []

        async def receive() -> Any:
            return {"type": "http.request", "body": content, "more_body": False}

        async def send(message: Any) -> None:
            sent.append(message)

        await self._page(scope, receive, send)
        answer = b"".join(each.get("body", b"") for each in sent)
        return sent[0]["status"], json.loads(answer)

    async def message(self, sink: str, point: str, payload: bytes, **more: Any) -> dict[str, Any]:
        """The answer to a message on the topic of a point; ``arrived`` is now if it is left out."""
        where, receiver = self.inputs[sink]
        name = point if where == PLACE else topic_level(point)
        topic = where.replace("{device}", "boiler").replace("{point}", name)
        answer = await receiver.handle(InputMessage(topic, payload, **{"arrived": self.moment, **more}))
        assert answer is not None
        content: dict[str, Any] = json.loads(answer)
        return content

    async def fleet(self, content: dict[str, Any]) -> dict[str, Any]:
        """The answer to a request to the owner of the link."""
        return await self._fleet.take(command_subject("hall", "hall"), json.dumps(content).encode())


def _ignore(_: object) -> None:
    """Do nothing with samples or an interval."""
