"""A collector in a process of its own over recorded devices, and all ways to command it: for attacks on commands.

Written from the documentation alone: nothing of busway is imported but its program is started.

1. Each value that is asked for has its image on the wire, computed here from the words of the device file.
2. People have tokens of the page by name; brokers are asked without credentials.
"""

import asyncio
import concurrent.futures
import contextlib
import http.client
import importlib.util
import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from foreign_servers import ForeignServer, free_port, mosquitto, nats_server
from missing_peers import installed
from wire_recorder import WireRecorder

LIMIT = 60.0
PEOPLE = {
    "vera": ("view", "vera-0123456789-vera"),
    "anna": ("operate", "anna-0123456789-anna"),
    "ben": ("operate", "ben-90123456789-ben"),
    "carl": ("configure", "carl-0123456789-carl"),
}
PROFILE = """\
[[unit]]
[[unit.point]]
name = "whole"
address = "4x1"
minimum = 10
maximum = 60000
write = { verify = "read-back", step = 10 }
[[unit.point]]
name = "scaled"
address = "4x11"
type = "int32"
scale = 0.5
minimum = -1000
maximum = 1000000
[[unit.point]]
name = "heat"
address = "4x21"
type = "float32"
minimum = 0
maximum = 100000
write = { verify = "4x23" }
[[unit.point]]
name = "shown"
address = "4x23"
type = "float32"
access = "read"
[[unit.point]]
name = "text"
address = "4x31"
type = "string:16"
[[unit.point]]
name = "pump"
address = "4x41"
write = { on = 170, off = 85 }
[[unit.point]]
name = "door"
address = "4x42.3"
[[unit.point]]
name = "mode"
address = "4x43"
enumeration = { off = 0, auto = 1, hand = 2 }
[[unit.point]]
name = "coil"
address = "0x5"
write = { verify = "read-back" }
[[unit.point]]
name = "level"
address = "3x1"
"""
MIRRORS = {20: 22, 21: 23}
Image = tuple[str, int, int, tuple[int, ...]]
"""Link, unit, address and items of a write on the wire; of one bit of a register, the bit alone."""


@dataclass(frozen=True)
class Wish:
    """What a person wants once: a key (or none), a point, and a value."""

    key: str | None
    device: str
    point: str
    value: Any

    def image(self, places: dict[str, tuple[str, int]]) -> Image:
        """What it would be on the wire."""
        link, unit = places[self.device]
        address, items = _registers(self.point, self.value)
        return link, unit, address, items


def _registers(point: str, value: Any) -> tuple[int, tuple[int, ...]]:
    if point == "whole":
        return 0, (value,)
    if point == "scaled":
        return 10, struct.unpack(">2H", struct.pack(">i", int(value * 2)))
    if point == "heat":
        return 20, struct.unpack(">2H", struct.pack(">f", value))
    if point == "text":
        return 30, struct.unpack(">8H", value.encode().ljust(16, b"\0"))
    if point == "pump":
        return 40, (170 if value else 85,)
    if point == "door":
        return 41, (int(value),)
    if point == "mode":
        return 42, ({"off": 0, "auto": 1, "hand": 2}[value],)
    assert point == "coil"
    return 4, (int(value),)


@dataclass
class Told:
    """An answer: of which wish, by whom, on which way, and what it said; `state` is empty where nothing came."""

    wish: Wish
    by: str
    way: str
    state: str = ""
    content: dict[str, Any] = field(default_factory=dict)
    status: int = 0
    begun: float = 0.0
    ended: float = 0.0
    until: float = float("inf")
    boot: int = 0


class CommandedPlant:
    """Devices, brokers, and a collector that tests start, ask and end."""

    def __init__(self, folder: Path, wire: WireRecorder, *, brokers: bool = True, runner: tuple[str, ...] = ()) -> None:
        self.folder, self.wire = folder, wire
        self.port = free_port()
        self.places: dict[str, tuple[str, int]] = {}
        self._links = ""
        for link, units in (("hall", (1, 2)), ("roof", (1,))):
            url = wire.open(link, units)
            self._links += f'[[link]]\nname = "{link}"\nurl = "{url}"\ntimeout = 0.4\n'
            for unit in units:
                self.places[f"{link}-{unit}"] = link, unit
                wire.units[link, unit].mirrors = dict(MIRRORS)
                self._links += f'[[device]]\nname = "{link}-{unit}"\nlink = "{link}"\nunit = {unit}\n'
                self._links += 'profile = "valve.toml"\n'
        (folder / "valve.toml").write_text(PROFILE)
        self.mqtt: ForeignServer | None = None
        self.nats: ForeignServer | None = None
        self._stack = contextlib.ExitStack()
        if brokers and importlib.util.find_spec("aiomqtt") and installed("mosquitto"):
            self.mqtt = self._stack.enter_context(mosquitto(folder))
        if brokers and importlib.util.find_spec("nats") and installed("nats-server"):
            self.nats = self._stack.enter_context(nats_server(folder))
        self.configure(0.1)
        data = folder / "data"
        data.mkdir()
        tokens = data / "page-tokens"
        tokens.touch(0o600)
        tokens.write_text("".join(f"{role} {token} {name}\n" for name, (role, token) in PEOPLE.items()))
        self._command = [sys.executable, *(runner or ("-m", "busway")), "collect", str(folder / "plant.toml")]
        self._log = (folder / "collect.log").open("ab")
        self._process: subprocess.Popen[bytes] | None = None
        self.boot = 0
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._mqtt_client: Any = None  # Any: of a package that may not be there
        self._mqtt_answers: dict[bytes, concurrent.futures.Future[dict[str, Any]]] = {}
        self._nats_client: Any = None
        if self.mqtt is not None:
            self._mqtt_connect()

    # The collector.

    def configure(self, period: float) -> str:
        text = f'[collector]\nstore = "data"\npage = "127.0.0.1:{self.port}"\n[poll_class]\nall.period = {period}\n'
        text += self._links
        points = '["*/whole", "*/scaled", "hall-?/text", "hall-1/heat", "*/level"]'
        if self.mqtt is not None:
            text += f'[[sink]]\nname = "broker"\nurl = "mqtt://127.0.0.1:{self.mqtt.port}"\ntopic = "s/{{device}}"\n'
            text += f'commands = {{ points = {points}, topic = "plant/{{device}}/{{point}}/set" }}\n'
        if self.nats is not None:
            text += f'[[sink]]\nname = "stream"\nurl = "nats://127.0.0.1:{self.nats.port}"\nsubject = "s.{{device}}"\n'
            text += f'stream = "S"\ncommands = {{ points = {points}, subject = "plant.{{device}}.{{point}}.set" }}\n'
        (self.folder / "plant.toml").write_text(text)
        return text

    def start(self) -> None:
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=self._log
        )
        self.boot += 1

    @property
    def process(self) -> "subprocess.Popen[bytes]":
        assert self._process is not None
        return self._process

    def end(self, number: int = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        return self.process.wait(LIMIT)

    def wait_until_up(self) -> None:
        """All devices are polled, or known to be silent, and the page answers."""
        limit = time.monotonic() + LIMIT
        while True:
            with contextlib.suppress(OSError, http.client.HTTPException):
                devices = self.ask("GET", "devices")[1]["devices"]
                if all(each["state"] != "not asked yet" for each in devices):
                    return
            assert self.process.poll() is None, self.log()
            assert time.monotonic() < limit, self.log()
            time.sleep(0.02)

    def log(self) -> str:
        return (self.folder / "collect.log").read_text()

    def audit(self) -> list[dict[str, Any]]:
        path = self.folder / "data" / "audit.log"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def close(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._log.close()
        if self._mqtt_client is not None:
            self._mqtt_client.disconnect()
            self._mqtt_client.loop_stop()
        if self._nats_client is not None:
            asyncio.run_coroutine_threadsafe(self._nats_client.close(), self._loop).result(10)
        asyncio.run_coroutine_threadsafe(_end_of_tasks(), self._loop).result(10)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)
        self._loop.close()
        self._stack.close()

    # Ways to command it.

    def ask(self, method: str, path: str, body: Any = None, by: str | None = "vera", **headers: str) -> tuple[int, Any]:
        """Ask the API; status and content."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=LIMIT)
        sent = dict(headers)
        if by in PEOPLE:
            sent["Authorization"] = f"Bearer {PEOPLE[by][1]}"
        data = None
        if body is not None:
            data = body if isinstance(body, bytes) else json.dumps(body).encode()
            sent.setdefault("Content-Type", "application/json")
        try:
            connection.request(method, f"/api/{path}", data, sent)
            answer = connection.getresponse()
            return answer.status, json.loads(answer.read() or b"null")
        finally:
            connection.close()

    def send(self, wish: Wish, by: str | None, way: str, seconds: float = 30.0) -> Told:
        """Command it in one step on a way: api, mqtt or nats."""
        told = Told(wish, by or "", way, begun=time.time(), boot=self.boot)
        told.until = told.begun + seconds
        body: dict[str, Any] = {"value": wish.value, "expires": told.until}
        if wish.key is not None:
            body["key"] = wish.key
        try:
            if way == "api":
                body |= {"device": wish.device, "point": wish.point}
                told.status, told.content = self.ask("POST", "commands", body, by)
            elif way == "mqtt":
                told.content = self._by_mqtt(wish, json.dumps(body)).result(5)
            else:
                told.content = self._by_nats(wish, json.dumps(body))
        except (OSError, http.client.HTTPException, TimeoutError, concurrent.futures.TimeoutError, ValueError):
            told.content = {}
        told.ended = time.time()
        told.state = str((told.content or {}).get("state", ""))
        return told

    def _mqtt_connect(self) -> None:
        assert self.mqtt is not None
        import paho.mqtt.client as paho

        self._mqtt_client = client = paho.Client(paho.CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
        client.on_connect = lambda *arguments: client.subscribe("answers/#", qos=1)
        client.on_message = self._mqtt_answer
        client.reconnect_delay_set(1, 1)
        client.connect("127.0.0.1", self.mqtt.port)
        client.loop_start()

    def _mqtt_answer(self, client: Any, data: Any, message: Any) -> None:  # Any: of paho
        waiting = self._mqtt_answers.pop(getattr(message.properties, "CorrelationData", b""), None)
        if waiting is not None and not waiting.done():
            waiting.set_result(json.loads(message.payload))

    def _by_mqtt(
        self, wish: Wish, payload: str, *, retain: bool = False, **properties: Any
    ) -> "concurrent.futures.Future[dict[str, Any]]":
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        made = Properties(PacketTypes.PUBLISH)
        made.ResponseTopic = "answers/me"
        made.CorrelationData = os.urandom(8)
        for name, value in properties.items():
            setattr(made, name, value)
        waiting = self._mqtt_answers[made.CorrelationData] = concurrent.futures.Future()
        topic = f"plant/{wish.device}/{wish.point}/set"
        self._mqtt_client.publish(topic, payload, qos=1, retain=retain, properties=made)
        return waiting

    def retained(self, wish: Wish) -> None:
        """Leave a retained command at the broker."""
        self._by_mqtt(wish, json.dumps({"value": wish.value}), retain=True)

    def _by_nats(self, wish: Wish, payload: str) -> dict[str, Any]:
        async def request() -> dict[str, Any]:
            import nats

            assert self.nats is not None
            if self._nats_client is None:
                self._nats_client = await nats.connect(
                    f"nats://127.0.0.1:{self.nats.port}",
                    reconnect_time_wait=0.2,
                    max_reconnect_attempts=-1,
                    error_cb=_nothing,
                )
            subject = f"plant.{wish.device}.{wish.point}.set"
            try:
                reply = await self._nats_client.request(subject, payload.encode(), timeout=5)
            except Exception:  # of the package: no answer of whatever kind
                return {}
            found: dict[str, Any] = json.loads(reply.data)
            return found

        return asyncio.run_coroutine_threadsafe(request(), self._loop).result(LIMIT)

    @property
    def ways(self) -> list[str]:
        return ["api", *(["mqtt"] if self.mqtt else []), *(["nats"] if self.nats else [])]


async def _nothing(error: Exception) -> None:
    """A broker that goes and comes is meant."""


async def _end_of_tasks() -> None:
    tasks = asyncio.all_tasks() - {asyncio.current_task()}
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
