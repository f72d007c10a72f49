"""Sink that publishes samples by MQTT 5, with discovery by Home Assistant.

Knows topics and payloads; the protocol is aiomqtt's (``busway[mqtt]``).

1. QoS 1: `send` returns when the broker has taken every message. A message carries the user property ``key``; if the
   message is sent again, its key is the same.
2. One message for each device and commit (`documents`), or with ``per_point`` one for each sample, in order.
3. ``PREFIX/status``, with the part of the topic before its first ``{`` as PREFIX, is ``online`` while connected, and
   then ``offline``, also by the last will. It is retained. It is ``status`` if nothing stands before that.
4. Events of alarms go to ``PREFIX/alarms``, or ``alarms``, one message each.
5. Discovery needs a topic for each point. The description of a point is sent to Home Assistant, retained, before the
   first sample of the point in each connection, and again when the configuration of the collector was replaced. It says
   what the file says about the point (`home_assistant`); a point that nothing describes is announced with its first
   value.
"""

import contextlib
import json
import re
import ssl
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final

from ....errors import ConfigError
from ....extras import require
from ....options.sinks import MqttOptions
from ....points.point import Point
from ..store.committed_samples import CommittedAlarm, CommittedSample
from .documents import alarm_document, documents, sample_document, sample_key
from .home_assistant import entity, kind_of, kind_of_value
from .interface import SinkDown, SinkRefused, all_taken
from .mqtt_connection import MqttPublisher, connect

_USUAL: Final = MqttOptions()
IN_FLIGHT: Final = 64
"""Messages that are sent together; the next ones are sent when all of these are acknowledged."""


@dataclass(frozen=True, slots=True)
class _Message:
    """A message to publish over MQTT.

    Attributes:
        topic: its topic.
        payload: its content.
        key: sent as the user property ``key``, so that receivers recognise a message that comes again.
        retain: whether the broker keeps the message for later subscribers.
    """

    topic: str
    payload: bytes
    key: str
    retain: bool

    def properties(self) -> Any:
        """Return the MQTT 5 properties of the message, which carry its key, as an object of the paho library."""
        found = import_module("paho.mqtt.properties").Properties(
            import_module("paho.mqtt.packettypes").PacketTypes.PUBLISH
        )
        found.UserProperty = ("key", self.key)
        return found


class MqttSink:
    """Sink that publishes samples and alarm events to an MQTT broker, with discovery by Home Assistant if wanted."""

    def __init__(
        self,
        host: str,
        port: int = 1883,
        *,
        topic: str = _USUAL.topic,
        per_point: bool = _USUAL.per_point,
        retain: bool = _USUAL.retain,
        discovery: str | None = _USUAL.discovery,
        user: str | None = None,
        password: str | None = None,
        tls: ssl.SSLContext | None = None,
        client_id: str | None = None,
        timeout: float = 10.0,
    ) -> None:
        """Set the MQTT broker and options of the sink; nothing is sent yet.

        Args:
            host, port: the broker.
            topic: the topic of samples, with ``{device}``; with ``per_point``, ``/{point}`` is added if it is missing.
            per_point: whether there is a message for each sample; else there is one for each device and commit.
            retain: whether the broker keeps the last message of each topic of samples.
            discovery: prefix of Home Assistant's discovery topics, such as ``homeassistant``; needs ``per_point``. None
                for no discovery.
            user, password: credentials for the broker.
            tls: the TLS context; None for no encryption.
            client_id: names this client to the broker; None for one that the library makes.
            timeout: seconds for connecting, and for an acknowledgement.

        Raises:
            ConfigError: the topic lacks ``{device}`` or has wildcards, or discovery without ``per_point``.
            MissingExtra: aiomqtt is not installed.
        """
        require("aiomqtt", "a sink over MQTT")
        if "{device}" not in topic or "+" in topic or "#" in topic:
            raise ConfigError(f"a topic has {{device}} and no wildcards, not {topic!r}", key="topic")
        if discovery is not None and not per_point:
            raise ConfigError("discovery needs per_point = true: an entity has one topic", key="discovery")
        self._topic = topic if not per_point or "{point}" in topic else f"{topic}/{{point}}"
        before = topic.partition("{")[0]
        prefix = f"{before.rstrip('/')}/" if before else ""  # no level that is empty, unless the topic has it
        self._status_topic, self._alarm_topic = f"{prefix}status", f"{prefix}alarms"
        self._per_point, self._retain, self._discovery = per_point, retain, discovery
        self._address: dict[str, Any] = {"hostname": host, "port": port, "username": user, "password": password}
        self._address |= {"tls_context": tls, "identifier": client_id, "timeout": timeout}
        self._where = f"{host}:{port}"
        self._timeout = timeout
        self._client: Any = None  # aiomqtt is loaded when it is used
        self._publisher: MqttPublisher | None = None
        self._points: Mapping[tuple[str, str], Point] = {}
        self._announced: set[tuple[str, str]] = set()
        self._announced_by: Mapping[tuple[str, str], Point] = self._points

    def describe(self, points: Mapping[tuple[str, str], Point]) -> None:
        """Set the points, by device and name, that are described to Home Assistant. Safe from any thread."""
        self._points = points

    async def open(self) -> None:
        """Connect to the broker, and publish that this collector is online.

        Raises:
            SinkDown: the broker cannot be reached, or refuses the connection.
        """
        mqtt = import_module("aiomqtt")
        will = mqtt.Will(self._status_topic, b"offline", qos=1, retain=True)
        client = mqtt.Client(**self._address, will=will, protocol=mqtt.ProtocolVersion.V5)
        publisher = MqttPublisher(client, self._timeout)
        try:
            await connect(client)
            self._client, self._publisher = client, publisher
            await client.publish(self._status_topic, b"online", qos=1, retain=True)
        except (mqtt.MqttError, OSError) as error:
            raise SinkDown(f"the broker {self._where} cannot be reached: {error}") from error
        self._announced.clear()

    async def close(self) -> None:
        """Publish that this collector is offline, and disconnect; the broker then does not publish the last will."""
        client, self._client, self._publisher = self._client, None, None
        if client is None:
            return
        gone = (import_module("aiomqtt").MqttError, OSError)  # the broker, or the connection to it
        with contextlib.suppress(*gone):
            await client.publish(self._status_topic, b"offline", qos=1, retain=True, timeout=1.0)
        with contextlib.suppress(*gone):
            await client.__aexit__(None, None, None)

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Publish samples, and wait until the broker has taken them.

        With discovery, points that were not announced to Home Assistant in this connection are announced before.

        Raises:
            SinkRefused: the broker refuses a message for good.
            SinkDown: the broker does not take messages now. Some samples may have arrived.
        """
        fresh: dict[tuple[str, str], _Message] = {} if self._discovery is None else self._discoveries(samples)
        await self._publish([*fresh.values(), *self._messages(samples)])
        self._announced |= fresh.keys()

    async def send_alarms(self, alarms: Sequence[CommittedAlarm]) -> None:
        """Publish alarm events, and wait until the broker has taken them. Raises errors like `send`."""
        await self._publish(
            [_Message(self._alarm_topic, each.encode(), each.key, False) for each in map(alarm_document, alarms)]
        )

    async def _publish(self, messages: Sequence[_Message]) -> None:
        """Publish messages, and wait until the broker has taken them all.

        Raises:
            SinkRefused: the broker refuses a message for good; the other messages may have arrived or not. If the
                broker ended the connection because of that message, the sink is connected again before.
            SinkDown: no answer came, the broker does not take a message now, or the connection is lost.
        """
        mqtt = import_module("aiomqtt")
        try:
            publisher = self._connected()
            for each in messages:
                publisher.check_size(each.topic, each.payload, each.properties())
            for begin in range(0, len(messages), IN_FLIGHT):
                await all_taken(
                    publisher.publish_taken(each.topic, each.payload, retain=each.retain, properties=each.properties())
                    for each in messages[begin : begin + IN_FLIGHT]
                )
        except SinkRefused:
            if publisher.has_ended:
                await self.close()
                await self.open()
            raise
        except (mqtt.MqttError, OSError) as error:
            raise SinkDown(f"the broker {self._where} does not answer: {error}") from error

    def _connected(self) -> MqttPublisher:
        if self._publisher is None:
            raise SinkDown(f"the broker {self._where} is not connected")
        return self._publisher

    def _messages(self, samples: Sequence[CommittedSample]) -> list[_Message]:
        if not self._per_point:
            return [
                _Message(self._name(each.device), each.encode(), each.key, self._retain) for each in documents(samples)
            ]
        return [
            _Message(
                self._name(sample.device, sample.point),
                json.dumps(sample_document(sample), ensure_ascii=False).encode(),
                sample_key(sample),
                self._retain,
            )
            for sample in samples
        ]

    def _name(self, device: str, point: str = "") -> str:
        return self._topic.replace("{device}", topic_level(device)).replace("{point}", topic_level(point))

    def own_topic(self, device: str, point: str) -> str:
        """Return the topic for samples of a point if it is that of the status or of alarms; else an empty text."""
        name = self._name(device, point)
        return name if name in (self._status_topic, self._alarm_topic) else ""

    def place_of(self, device: str, point: str) -> tuple[str, str]:
        """Return the names of a device and a point as the receiver has them (`TopicSink`): as levels of topics.

        With discovery, the names in Home Assistant instead, where more characters become ``_``. Without ``per_point``
        no topic has the name of the point, and it is returned unchanged.
        """
        if self._discovery is not None:
            return _plain(device), _plain(point)
        return topic_level(device), topic_level(point) if self._per_point else point

    def _discoveries(self, samples: Sequence[CommittedSample]) -> dict[tuple[str, str], _Message]:
        """Return discovery messages for the points of samples that were not announced to Home Assistant yet.

        After `describe` has set other points, all points count as not announced. A point that is not described is left
        out until it has a sample with a value.
        """
        points = self._points
        if points is not self._announced_by:
            self._announced.clear()
            self._announced_by = points
        found: dict[tuple[str, str], _Message] = {}
        for sample in samples:
            key = (sample.device, sample.point)
            if key in self._announced or key in found:
                continue
            point = points.get(key)
            kind = kind_of_value(sample.value) if point is None else kind_of(point)
            if kind is None:
                continue
            unit, meta = (sample.unit_of_measure, {}) if point is None else (point.unit_of_measure, point.meta)
            component, said = entity(kind, unit, meta)
            name = f"{self._discovery}/{component}/{_plain(sample.device)}/{_plain(sample.point)}/config"
            content = self._entity(sample, component) | said
            found[key] = _Message(name, json.dumps(content, ensure_ascii=False).encode(), name, True)
        return found

    def _entity(self, sample: CommittedSample, component: str) -> dict[str, Any]:
        """Return the names, topics and templates of a Home Assistant entity, without the options from `entity`."""
        topic = self._name(sample.device, sample.point)
        value = "{{ value_json.value }}" if component == "sensor" else "{{ 'ON' if value_json.value else 'OFF' }}"
        return {
            "name": sample.point,
            "unique_id": f"busway_{_plain(sample.device)}_{_plain(sample.point)}",
            "state_topic": topic,
            "value_template": value,
            "json_attributes_topic": topic,
            "availability": [
                {"topic": self._status_topic},
                {
                    "topic": topic,
                    "value_template": "{{ 'offline' if value_json.quality == 'bad' else 'online' }}",
                },
            ],
            "availability_mode": "all",
            "device": {"identifiers": [f"busway_{_plain(sample.device)}"], "name": sample.device},
        }


def topic_level(name: str) -> str:
    """Return a name as one level of an MQTT topic: ``/``, ``+``, ``#`` and the character 0 become ``_``."""
    return re.sub(r"[/+#\x00]", "_", name)


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", name)
