"""Topics of a sink over MQTT; what brokers do with them is in `test_real_servers`."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.sinks.mqtt import MqttSink
from busway.apps.collector.store.committed_samples import CommittedAlarm

aiomqtt = pytest.importorskip("aiomqtt")


class Below:
    """The client of paho, which takes each message."""

    def __init__(self, topics: list[str]) -> None:
        self.topics = topics
        self.on_connect = self.on_publish = self.on_disconnect = lambda *given: None

    def publish(self, topic: str, *_: object) -> SimpleNamespace:
        self.topics.append(topic)
        asyncio.get_running_loop().call_soon(lambda: self.on_publish(self, None, 1, SimpleNamespace(value=0)))
        return SimpleNamespace(rc=0, mid=1)


class Client:
    """A client of aiomqtt that is connected at once, and notes on which topics it sends."""

    def __init__(self, topics: list[str], *, will: Any, **_: object) -> None:  # aiomqtt.Will
        self.topics = topics
        self.topics.append(will.topic)
        self._client = Below(topics)
        self._disconnected = asyncio.get_running_loop().create_future()

    async def __aenter__(self) -> None:
        pass

    async def __aexit__(self, *_: object) -> None:
        pass

    async def publish(self, topic: str, *_: object, **__: object) -> None:
        self.topics.append(topic)


@pytest.mark.parametrize(
    ("topic", "prefix"),
    [
        ("busway/{device}", "busway/"),
        ("{device}", ""),
        ("{device}/{point}", ""),
        ("/{device}", "/"),
        ("a{device}", "a/"),
    ],
)
async def test_status_and_alarms_have_what_the_topic_has_before_the_device_and_no_empty_level_of_their_own(
    topic: str, prefix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    topics: list[str] = []
    monkeypatch.setattr(aiomqtt, "Client", lambda **options: Client(topics, **options))
    sink = MqttSink("127.0.0.1", topic=topic)
    await sink.open()
    await sink.send_alarms([CommittedAlarm(7, 0, AlarmEvent("pump-1", "speed", "H", AlarmEventKind.RAISED, 1))])
    await sink.close()
    status, alarms = f"{prefix}status", f"{prefix}alarms"
    assert topics == [status, status, alarms, status]
