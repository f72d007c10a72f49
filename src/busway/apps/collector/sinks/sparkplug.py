"""Sink for Sparkplug B 3.0: the collector is an edge node of a group; its devices are the devices of the edge node.

Knows topics, births, deaths and their order (Sparkplug 3.0 §5, §6); the payload is `sparkplug_payload`'s, the protocol
is aiomqtt's (``busway[sparkplug]``).

1. One connection, one edge node. Its last will is the death of the node, with the same number (bdSeq) as its birth. The
   number is kept in a file, so that it goes on after a restart.
2. A device is born with the last samples of all of its metrics known so far, and again when a metric is new, has
   another type, or no longer exists. Data are sent only after a birth. Samples from before the connection are marked as
   historical, and hosts do not show these. So when no more of them follow, a device whose last values were among them
   is born again.
3. Data are sent with QoS 0, as the standard demands. `send` returns when a later message with QoS 1 was acknowledged: a
   broker takes the messages of a connection in order, so it has the data too.
4. With a primary host, nothing is sent while the host is offline: the edge node dies at once, and samples wait in the
   store. A host that comes back does not know earlier births, so it gets births before data.
5. If a host asks for the births, they are published again, but at most once in `REBIRTH_PAUSE` seconds.
6. Events of alarms are values of the metric `ALARM_METRIC` of the edge node, JSON as over MQTT, whether their device is
   born or not.
7. If the configuration permits it, values that a host writes to metrics of devices (DCMD) are passed to the commands of
   the collector as they arrive (`SparkplugCommandTaker`). Their topics are subscribed to before the births are sent;
   messages that were retained before are not delivered.
8. A device dies when the collector suspends it, when it has no connection, or when its maintenance begins; its next
   sample that has none of these reasons causes a birth. Until then no birth of the device is published.
9. If a birth is too large for the broker, it is published without values.
"""

import asyncio
import contextlib
import json
import logging
import ssl
import time
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import groupby
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

from ....errors import ConfigError
from ....extras import require
from ....safe_files import write_whole
from ..samples import Quality, Reason, SampleValue, reason_text
from ..store.committed_samples import CommittedAlarm, CommittedSample
from .documents import alarm_document
from .interface import SinkDown, SinkRefused
from .mqtt import topic_level
from .mqtt_connection import MqttPublisher, connect
from .sparkplug_payload import DataType, Metric, SparkplugQuality, decode_command, encode_payload, type_of

REBIRTH_PAUSE: Final = 5.0
REBIRTH_METRIC: Final = "Node Control/Rebirth"
ALARM_METRIC: Final = "Alarms/Event"
"""The metric of the edge node whose values are events of alarms."""
MOST_METRICS: Final = 1000
"""Most metrics in one data message."""
_NUMBERS: Final = 256
"""Sequence numbers and numbers of connections are 0…255; 0 follows 255."""
_MOST_EXACT: Final = 2**53
"""Every integer whose absolute value is below it is exactly representable as float."""
_NO_DEVICE: Final = frozenset({Reason.SUSPENDED, Reason.NO_CONNECTION, Reason.MAINTENANCE})
"""Reasons of samples that mean that the device is not there, so that it has no birth (rule 8)."""
_QUALITIES: Final = {Quality.BAD: SparkplugQuality.BAD, Quality.UNCERTAIN: SparkplugQuality.STALE}

_log = logging.getLogger("busway.sinks")

Committed = TypeVar("Committed", CommittedSample, CommittedAlarm)


class _Device:
    """A device as a Sparkplug host sees it: its metrics with their last samples and types.

    Attributes:
        last: the last sample of each metric, by name of its point.
        kinds: the type of each metric, by name of its point.
        untyped: metrics that never had a value; their type is DOUBLE until the first value.
        behind: metrics whose last values were sent as historical ones since the birth, so that hosts do not show them.
        is_born: whether its birth was published in this connection, and no death after it.
        is_gone: whether it is suspended, without connection, or in maintenance.
    """

    def __init__(self) -> None:
        self.last: dict[str, CommittedSample] = {}
        self.kinds: dict[str, DataType] = {}
        self.untyped: set[str] = set()
        self.behind: set[str] = set()
        self.is_born = False
        self.is_gone = False

    def learn(self, sample: CommittedSample) -> bool:
        """Store a sample as the last one of its metric.

        Returns:
            Whether the device needs a new birth message, because a metric is new or has another type, or it is not
            born.
        """
        point = sample.point
        known = self.kinds.get(point)
        if sample.value is None:
            kind = known or DataType.DOUBLE
            if known is None:
                self.untyped.add(point)
        else:
            kind = _wider(None if point in self.untyped else known, sample.value)
            self.untyped.discard(point)
        self.kinds[point] = kind
        self.last[point] = sample
        return kind is not known or not self.is_born

    def forget(self, points: Collection[str]) -> None:
        """Remove the metrics of points that no longer exist. Each of these points must have a metric."""
        for point in points:
            del self.last[point], self.kinds[point]
        self.untyped.difference_update(points)
        self.behind.difference_update(points)


def _wider(known: DataType | None, value: SampleValue) -> DataType:
    """Return the type of a metric that gets a new value; ``known`` is its type so far, None for a new metric.

    A metric of type DOUBLE or UINT64 keeps its type for an integer that this type holds exactly; else the type is that
    of the value.
    """
    new = type_of(value)
    if not isinstance(value, int) or isinstance(value, bool):
        return new
    if known is DataType.DOUBLE and int(float(value)) == value:
        return known
    return known if known is DataType.UINT64 and value >= 0 else new


@dataclass(frozen=True, slots=True)
class SparkplugCommand:
    """A value that a host application writes to a metric of a device.

    Attributes:
        device, point: names.
        value: the value; None if the message has none.
        sent: when the host sent it, by the host's clock, seconds since 1970 UTC; None if the message has no time.
        is_retained: whether the broker keeps the message for later subscribers.
    """

    device: str
    point: str
    value: SampleValue | None
    sent: float | None
    is_retained: bool


class SparkplugCommandTaker(Protocol):
    """Interface of the receiver of commands from Sparkplug hosts.

    The sink calls its methods in its own thread; they must return at once.
    """

    def take(self, command: SparkplugCommand) -> None:
        """Take a command to write a point and return at once; the Sparkplug host gets no reply."""

    def note(self, error: str | None) -> None:
        """Learn why no commands can arrive now; ``error`` is None if they can arrive."""


COLLECTOR: Final = "{collector}"
"""Placeholder for the name of the collector in the name of an edge node."""


class SparkplugSink:
    """Sink that publishes samples and alarm events as a Sparkplug B edge node, and receives commands of hosts.

    Attributes:
        edge_node: the name of the edge node in all topics; `join` replaces ``{collector}`` in it.
        commands: takes the values that hosts write; None if hosts may write nothing. May be set before `open`.
    """

    def __init__(
        self,
        host: str,
        port: int = 1883,
        *,
        group: str,
        edge_node: str,
        primary_host: str | None = None,
        number_file: Path | None = None,
        user: str | None = None,
        password: str | None = None,
        tls: ssl.SSLContext | None = None,
        client_id: str | None = None,
        timeout: float = 10.0,
        now: Callable[[], int] = time.time_ns,
        commands: SparkplugCommandTaker | None = None,
    ) -> None:
        """Set the broker, the names of the edge node and other options; nothing is sent yet.

        Args:
            host, port: the broker.
            group, edge_node: names in all topics; without ``/``, ``+`` and ``#``.
            primary_host: name of the host application that must be online before anything is sent; None for none.
            number_file: file that keeps the number of the last connection (bdSeq) over a restart; None to keep it in
                memory only, where the first connection has 1.
            user, password: credentials for the broker.
            tls: the TLS context; None for no encryption.
            client_id: names this client to the broker; None for one that the library makes.
            timeout: seconds for connecting, for an acknowledgement, and for the state of the primary host.
            now: returns nanoseconds since 1970 UTC.
            commands: takes the values that hosts write; None if hosts may write nothing.

        Raises:
            ConfigError: a name is empty or has a character that separates levels of topics.
            MissingExtra: aiomqtt or protobuf is not installed.
        """
        for package in ("aiomqtt", "google.protobuf"):
            require(package, "a sink for Sparkplug")
        for key, name in (("group", group), ("edge_node", edge_node), ("primary_host", primary_host or "-")):
            if not name or topic_level(name) != name:
                raise ConfigError(f"a name without / + # is needed, not {name!r}", key=key)
        self._group, self._primary_host = group, primary_host
        self.edge_node: str = edge_node
        self._number_file, self._timeout, self._now = number_file, timeout, now
        self._address: dict[str, Any] = {"hostname": host, "port": port, "username": user, "password": password}
        self._address |= {"tls_context": tls, "identifier": client_id, "timeout": timeout}
        self._where = f"{host}:{port}"
        self._client: Any = None  # aiomqtt is loaded when it is used
        self._publisher: MqttPublisher | None = None
        self._listener: asyncio.Task[None] | None = None
        self._sending = asyncio.Lock()
        self._devices: dict[str, _Device] = {}
        self._number = self._sequence = 0
        self._is_born = False
        self._connected_at = 0
        self._last_birth = 0.0
        self._host_online = asyncio.Event()
        self._host_time = 0
        self._host_left = False
        self._disturbance = asyncio.Event()
        self._last_alarm: Metric | None = None
        self._rebirth: asyncio.Task[None] | None = None
        self._asked_at: float | None = None
        self._published: list[CommittedSample | CommittedAlarm] = []
        self._passed: set[CommittedSample | CommittedAlarm] = set()
        self.commands: SparkplugCommandTaker | None = commands

    # Life

    def join(self, member: str) -> None:
        """Publish as the edge node of one collector of a fleet; called before `open`.

        Args:
            member: the name of the collector; it stands for ``{collector}`` in the name of the edge node.

        Raises:
            ConfigError: the name has no ``{collector}``: two collectors would be one edge node.
        """
        if COLLECTOR not in self.edge_node:
            raise ConfigError(
                f"names one edge node, and each collector of a fleet is one of its own: add {COLLECTOR}",
                key="edge_node",
            )
        self.edge_node = self.edge_node.replace(COLLECTOR, member)
        if self._address["identifier"] is not None:  # a broker ends a connection when another one has its name
            self._address["identifier"] += f"-{member}"

    async def open(self) -> None:
        """Connect to the broker, wait for the primary host, and publish the births of the edge node and its devices.

        Devices that are not there have no birth (rule 8). The number of the connection is written to its file before.

        Raises:
            SinkDown: the broker cannot be reached, the primary host is not online, or the file cannot be written.
        """
        mqtt = import_module("aiomqtt")
        self._number = await asyncio.to_thread(self._next_number)
        will = mqtt.Will(self._topic("NDEATH"), self._death(), qos=1, retain=False)
        client = mqtt.Client(**self._address, will=will, protocol=mqtt.ProtocolVersion.V5, clean_start=True)
        publisher = MqttPublisher(client, self._timeout)
        self._host_online.clear()
        self._disturbance.clear()
        self._host_time, self._host_left, self._asked_at = 0, False, None
        try:
            await connect(client)
            self._client, self._publisher = client, publisher
            self._listener = asyncio.create_task(self._listen(client), name="busway sparkplug messages")
            self._listener.add_done_callback(_log_defect)
            self._listener.add_done_callback(lambda _: self._disturbance.set())
            await client.subscribe(self._topic("NCMD"), qos=1)
            if self.commands is not None:
                await client.subscribe(f"{self._topic('DCMD')}/+", options=_fresh_alone())
            if self._primary_host is not None:
                await client.subscribe(f"spBv1.0/STATE/{self._primary_host}", qos=1)
                async with asyncio.timeout(self._timeout):
                    await self._host_online.wait()
            async with self._sending:
                self._connected_at = self._now()
                await self._births()
            self._note_commands(None)
        except TimeoutError:
            raise SinkDown(f"the primary host {self._primary_host} is not online at {self._where}") from None
        except (mqtt.MqttError, OSError) as error:
            raise SinkDown(f"the broker {self._where} cannot be reached: {error}") from error

    async def close(self) -> None:
        """Publish the death of the edge node, if it was born, and disconnect. `open` publishes the births again."""
        self._note_commands(f"the broker {self._where} is not connected")
        self._passed.clear()  # the broker may not have them
        tasks = [task for task in (self._listener, self._rebirth) if task is not None]
        self._listener = self._rebirth = None
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        client, self._client, self._publisher = self._client, None, None
        if client is None:
            return
        gone = (import_module("aiomqtt").MqttError, OSError)  # the broker, or the connection to it
        if self._is_born:
            self._is_born = False
            with contextlib.suppress(*gone):
                await client.publish(self._topic("NDEATH"), self._death(), qos=1, timeout=1.0)
        with contextlib.suppress(*gone):
            await client.__aexit__(None, None, None)
        for device in self._devices.values():
            device.is_born = False

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Publish samples, with the births and deaths that they need, and wait until the broker has them.

        If the broker refuses a part of a batch, the samples that were published are left out when the batch is sent
        again in parts.

        Raises:
            SinkRefused: a message is too large for the broker.
            SinkDown: the connection is lost, or the primary host is offline; some samples may have arrived.
        """
        with self._once(samples) as fresh:
            async with self._delivering():
                for name, those in groupby(sorted(fresh, key=_device_of), _device_of):
                    await self._send_device(name, list(those))

    async def send_alarms(self, alarms: Sequence[CommittedAlarm]) -> None:
        """Publish alarm events, and wait until the broker has them. Raises errors like `send`."""
        with self._once(alarms) as fresh:
            async with self._delivering():
                for alarm in fresh:
                    event = _alarm_metric(alarm)
                    await self._publish("NDATA", [replace(event, is_historical=event.time < self._connected_at)])
                    self._last_alarm = event
                    self._published.append(alarm)

    def remember(self, samples: Sequence[CommittedSample]) -> None:
        """Learn which samples were sent last before a restart; births contain them until newer samples are sent."""
        for sample in sorted(samples, key=lambda each: each.time):
            device = self._devices.setdefault(sample.device, _Device())
            device.learn(sample)
            device.is_gone = sample.reason in _NO_DEVICE

    async def show_current(self, points: Collection[tuple[str, str]] | None = None) -> None:
        """Publish births again for devices of which hosts show old values or removed points.

        Hosts show old values if newer ones were sent as historical. A device of which no point exists any more is
        reported dead and forgotten.

        Args:
            points: device and name of each point that exists; None if all points that were sent exist.

        Raises:
            SinkDown: the connection is lost, or the primary host is offline.
        """
        self._disturbance.clear()
        self._check_connection()
        self._check_host()
        left = {} if points is None else self._without(points)
        due = [name for name, device in self._devices.items() if name in left or (device.is_born and device.behind)]
        if due:
            async with self._delivering():
                for name in due:
                    with contextlib.suppress(SinkRefused):  # it is as large as it was
                        await self._show_device(name, left.get(name, ()))

    async def disturbed(self) -> None:
        """Wait until the primary host goes offline or the connection ends, and return."""
        await self._disturbance.wait()

    def _without(self, points: Collection[tuple[str, str]]) -> dict[str, list[str]]:
        """Return for each device the names of its metrics whose points are not in ``points``; others are left out.

        ``points`` has device and name of each point that exists.
        """
        found = {
            name: [point for point in device.last if (name, point) not in points]
            for name, device in self._devices.items()
        }
        return {name: gone for name, gone in found.items() if gone}

    def place_of(self, device: str, point: str) -> tuple[str, str]:
        """Return the name of a device in topics, and the name of a point's metric: its own name (`TopicSink`)."""
        return topic_level(device), point

    @contextlib.contextmanager
    def _once(self, wanted: Sequence[Committed]) -> Iterator[list[Committed]]:
        """Return a context manager whose block gets the samples or alarm events of ``wanted`` that it must publish.

        If the block raises `SinkRefused`, the batch is sent again in parts: then those that the block has published are
        left out, until the sink is closed or a later batch is sent.
        """
        first = min((each.commit for each in wanted), default=0)
        self._passed = {each for each in self._passed if each.commit >= first}
        self._published = []
        try:
            yield [each for each in wanted if each not in self._passed]
        except SinkRefused:
            self._passed.update(self._published)
            raise

    @contextlib.asynccontextmanager
    async def _delivering(self) -> AsyncIterator[None]:
        """Return a context manager for publishing messages; when its block has ended, the broker has all of them.

        Raises:
            SinkDown: the connection is lost, or the primary host is offline; some messages may have arrived.
        """
        mqtt = import_module("aiomqtt")
        self._check_connection()
        try:
            async with self._sending:
                self._check_host()
                yield
            await self._publish_acknowledged()
        except (mqtt.MqttError, OSError) as error:
            raise SinkDown(f"the broker {self._where} does not answer: {error}") from error
        self._check_host()

    async def _publish_acknowledged(self) -> None:
        """Publish an empty message with QoS 1 and wait for its answer: then the broker has all messages before it."""
        topic = f"busway/sparkplug/{self._group}/{self.edge_node}/delivered"
        await self._connected().publish(topic, b"")  # any answer, also that this topic is not permitted

    def _connected(self) -> MqttPublisher:
        if self._publisher is None:
            raise SinkDown(f"the broker {self._where} is not connected")
        return self._publisher

    def _check_connection(self) -> None:
        if self._listener is None or self._listener.done():
            raise SinkDown(f"messages of the broker {self._where} are no longer received")

    def _check_host(self) -> None:
        if self._primary_host is not None and (self._host_left or not self._host_online.is_set()):
            raise SinkDown(f"the primary host {self._primary_host} went offline")

    # Births, deaths, data; the lock is held

    async def _births(self) -> None:
        """Publish the birth of the edge node, then that of each device that has metrics and is not gone (rule 8).

        A birth tells hosts the names, types and last values of metrics.
        """
        self._sequence = 0
        now = self._now()
        self._last_birth = time.monotonic()
        metrics = [
            Metric("bdSeq", now, DataType.INT64, self._number),
            Metric(REBIRTH_METRIC, now, DataType.BOOLEAN, False),
        ]
        no_alarm = Metric(ALARM_METRIC, now, DataType.STRING, None)
        try:
            await self._publish("NBIRTH", [*metrics, self._last_alarm or no_alarm])
        except SinkRefused:  # an event that has just found room in a message of its own
            await self._publish("NBIRTH", [*metrics, no_alarm])
        self._is_born = True
        for name, device in self._devices.items():
            device.is_born = False
            if device.last and not device.is_gone:
                with contextlib.suppress(SinkRefused):  # its next sample is refused for it
                    await self._birth(name, device)

    async def _birth(self, name: str, device: _Device) -> None:
        metrics = [_metric(sample, device.kinds[point], unit=True) for point, sample in device.last.items()]
        try:
            await self._publish("DBIRTH", metrics, name)
        except SinkRefused:
            await self._publish("DBIRTH", [_without_value(each) for each in metrics], name)
        device.is_born = True
        device.behind.clear()

    async def _show_device(self, name: str, gone: Collection[str]) -> None:
        """Forget the metrics ``gone`` of a device, and publish its birth without them.

        A device without other metrics is forgotten, and its death published. Nothing is published for a device that is
        not born.
        """
        device = self._devices[name]
        device.forget(gone)
        if device.last and device.is_born:
            await self._birth(name, device)
        elif not device.last:
            del self._devices[name]
            if device.is_born:
                await self._publish("DDEATH", [], name)

    async def _send_device(self, name: str, samples: list[CommittedSample]) -> None:
        self._check_host()
        device = self._devices.setdefault(name, _Device())
        for is_gone, those in groupby(samples, lambda sample: sample.reason in _NO_DEVICE):
            device.is_gone = is_gone
            if is_gone:
                if device.is_born:
                    device.is_born = False
                    await self._publish("DDEATH", [], name)
                for sample in those:
                    device.learn(sample)
                    self._published.append(sample)
                continue
            for part in _parts(list(those)):
                known = dict(device.last), dict(device.kinds), set(device.untyped)
                try:
                    await self._send_part(name, device, part)
                except SinkRefused:  # what is too large for a message must not be in every birth
                    device.last, device.kinds, device.untyped = known
                    raise

    async def _send_part(self, name: str, device: _Device, samples: list[CommittedSample]) -> None:
        needed = [device.learn(sample) for sample in samples]
        is_new = any(needed)
        if is_new:
            await self._birth(name, device)
        metrics = []
        for sample in samples:
            is_historical = sample.time < self._connected_at
            metrics.append(_metric(sample, device.kinds[sample.point], is_historical=is_historical))
            if is_historical and not is_new:
                device.behind.add(sample.point)
            else:
                device.behind.discard(sample.point)
        await self._publish("DDATA", metrics, name)
        self._published += samples

    async def _publish(self, kind: str, metrics: Sequence[Metric], device: str | None = None) -> None:
        topic, content = self._topic(kind, device), encode_payload(metrics, self._now(), self._sequence)
        self._connected().check_size(topic, content)
        self._sequence = (self._sequence + 1) % _NUMBERS
        await self._client.publish(topic, content, qos=0, timeout=self._timeout)

    def _topic(self, kind: str, device: str | None = None) -> str:
        levels = ["spBv1.0", self._group, kind, self.edge_node]
        return "/".join(levels if device is None else [*levels, topic_level(device)])

    def _death(self) -> bytes:
        now = self._now()
        return encode_payload([Metric("bdSeq", now, DataType.INT64, self._number)], now, None)

    def _next_number(self) -> int:
        """Return the number of the next connection (bdSeq, 0…255), one more than the last, and write it to the file.

        Raises:
            SinkDown: the file cannot be written.
        """
        file = self._number_file
        if file is None:
            return (self._number + 1) % _NUMBERS
        try:
            last = int(json.loads(file.read_text("utf-8"))["bdSeq"])
        except (OSError, ValueError, KeyError, TypeError):  # none yet, or damaged: any number may begin
            last = -1
        number = (last + 1) % _NUMBERS
        try:
            write_whole(file, json.dumps({"bdSeq": number}))
        except OSError as error:
            raise SinkDown(f"the number of the connection cannot be kept in {file}: {error}") from error
        return number

    # What hosts say

    async def _listen(self, client: Any) -> None:
        """Receive messages of hosts until the connection ends: their state, requests for births, values to write."""
        mqtt = import_module("aiomqtt")
        with contextlib.suppress(mqtt.MqttError):  # sending finds that out
            async for message in client.messages:
                topic = str(message.topic)
                if topic.startswith("spBv1.0/STATE/"):
                    self._take_state(message.payload)
                elif topic == self._topic("NCMD"):
                    self._take_node_command(message.payload)
                elif self.commands is not None:
                    self._take_device_command(topic, message.payload, is_retained=bool(message.retain))

    def _take_state(self, content: bytes) -> None:
        try:
            state = json.loads(content)
            online, moment = state["online"] is True, int(state["timestamp"])
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            _log.warning("sink for Sparkplug: %s says a state that is none", self._primary_host)
            return
        if moment < self._host_time:  # an old last will that came late
            return
        self._host_time = moment
        if online:
            self._host_online.set()
            if self._host_left:
                self._ask_for_births()
        else:
            self._host_left = self._is_born
            self._host_online.clear()
            self._disturbance.set()

    def _take_node_command(self, content: bytes) -> None:
        try:
            wanted = dict(decode_command(content).values).get(REBIRTH_METRIC) is True
        except ValueError as error:
            _log.warning("sink for Sparkplug: a command that is no payload: %s", error)
            return
        if wanted:
            self._ask_for_births()

    def _ask_for_births(self) -> None:
        self._asked_at = time.monotonic()
        if self._rebirth is None or self._rebirth.done():
            self._rebirth = asyncio.create_task(self._births_again(), name="busway sparkplug rebirth")

    async def _births_again(self) -> None:
        """Publish all births again until no host asks for them, at most once in `REBIRTH_PAUSE` seconds (rule 5)."""
        with contextlib.suppress(import_module("aiomqtt").MqttError, SinkDown, SinkRefused):  # sending finds that out
            while self._asked_at is not None:
                await asyncio.sleep(max(0.0, self._last_birth + REBIRTH_PAUSE - self._asked_at))
                async with self._sending:
                    self._asked_at = None
                    if self._is_born and (self._primary_host is None or self._host_online.is_set()):
                        self._host_left = False
                        await self._births()

    def _take_device_command(self, topic: str, content: bytes, *, is_retained: bool) -> None:
        """Decode a host's message that writes to a device (DCMD), and pass each value to ``commands``.

        A message that cannot be decoded, or for a device that is not known, is logged.
        """
        assert self.commands is not None
        level = topic.rpartition("/")[2]
        devices = [name for name in self._devices if topic_level(name) == level]
        try:
            if len(devices) != 1:
                raise ValueError(f"{len(devices)} devices are called {level}")
            command = decode_command(content, self._devices[devices[0]].kinds)
        except ValueError as error:
            _log.warning("sink for Sparkplug: a command to a device is refused: %s", error)
            return
        sent = None if command.time is None else command.time / 1000
        for point, value in command.values:
            self.commands.take(SparkplugCommand(devices[0], point, value, sent, is_retained))

    def _note_commands(self, error: str | None) -> None:
        if self.commands is not None:
            self.commands.note(error)


def _fresh_alone() -> Any:  # as paho has it
    """Return MQTT options for a subscription that gets no retained messages, only those published after it.

    Messages keep the retain flag that their sender has set.
    """
    return import_module("paho.mqtt.subscribeoptions").SubscribeOptions(
        qos=1, noLocal=True, retainAsPublished=True, retainHandling=2
    )


def _log_defect(task: "asyncio.Task[None]") -> None:
    if not task.cancelled() and task.exception() is not None:
        _log.error("sink for Sparkplug: messages are no longer received", exc_info=task.exception())


def _alarm_metric(alarm: CommittedAlarm) -> Metric:
    return Metric(ALARM_METRIC, alarm.event.at, DataType.STRING, alarm_document(alarm).encode().decode())


def _device_of(sample: CommittedSample) -> str:
    return sample.device


def _parts(samples: list[CommittedSample]) -> Iterator[list[CommittedSample]]:
    """Yield the samples of a device in groups for one message each, in order.

    A group has at most `MOST_METRICS` samples, and only values of one type for each metric. Without samples there is
    one empty group.
    """
    begin = 0
    kinds: dict[str, DataType] = {}
    for place, sample in enumerate(samples):
        kind = None if sample.value is None else _kind_in_message(sample.value)
        is_other = kind is not None and kinds.setdefault(sample.point, kind) is not kind
        if is_other or place - begin == MOST_METRICS:
            yield samples[begin:place]
            begin, kinds = place, {} if kind is None else {sample.point: kind}
    yield samples[begin:]


def _kind_in_message(value: SampleValue) -> DataType:
    """Return the type of a value for `_parts`: an integer of less than `_MOST_EXACT` counts as DOUBLE, like floats."""
    kind = type_of(value)
    return DataType.DOUBLE if kind is DataType.INT64 and abs(int(value)) < _MOST_EXACT else kind


def _without_value(metric: Metric) -> Metric:
    others = tuple(each for each in metric.properties if each[0] == "engUnit")
    return replace(metric, value=None, properties=(("Quality", SparkplugQuality.STALE), *others))


def _metric(sample: CommittedSample, kind: DataType, *, is_historical: bool = False, unit: bool = False) -> Metric:
    """Return a sample as a Sparkplug metric; one that is not good has quality and reason as properties.

    Args:
        sample: the sample.
        kind: the type of the metric.
        is_historical: whether to mark the sample as historical, because it is from before the connection.
        unit: whether to add the unit of measure as a property, as in births.
    """
    properties: list[tuple[str, str | SparkplugQuality]] = []
    if sample.quality is not Quality.GOOD:
        properties += [("Quality", _QUALITIES[sample.quality]), ("reason", reason_text(sample.reason))]
    if unit and sample.unit_of_measure:
        properties.append(("engUnit", sample.unit_of_measure))
    return Metric(sample.point, sample.time, kind, _value(sample.value, kind), is_historical, tuple(properties))


def _value(value: SampleValue | None, kind: DataType) -> SampleValue | None:
    return float(value) if kind is DataType.DOUBLE and isinstance(value, int) else value
