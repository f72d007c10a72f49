"""A broker of a test that looks to a Sparkplug sink like aiomqtt: it can go away, and lose what was on its way.

It delivers what clients publish, and the last wills of clients that it loses, to `SparkplugHost`s at once and in order.
"""

import asyncio
import itertools
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import aiomqtt

Take = Callable[[str, bytes], None]


@dataclass
class SparkplugBroker:
    """What connects clients; ``FakeBroker().client`` stands for `aiomqtt.Client`.

    Attributes:
        is_down: whether nothing can connect.
        most: bytes of a message at most, as the broker announces it; None for any.
        loses_after: messages of a client that still arrive, before its connection ends and loses the others.
        retained: messages for later subscribers.
        take: gets each message that arrives.
        taken: how many have arrived.
        qualities: the type of each message that clients sent, as in its topic (``DDATA``), with its quality of service.
        is_mute: whether messages of QoS 1 are answered only by `answer`.
    """

    take: Take
    is_down: bool = False
    most: int | None = None
    loses_after: int | None = None
    retained: dict[str, bytes] = field(default_factory=dict)
    taken: int = 0
    qualities: list[tuple[str, int]] = field(default_factory=list)
    is_mute: bool = False
    clients: "list[FakeClient]" = field(default_factory=list)
    unanswered: list[Callable[[], object]] = field(default_factory=list)

    def client(self, **options: Any) -> "FakeClient":
        return FakeClient(self, options["will"])

    def say(self, topic: str, content: bytes, *, retain: bool = False) -> None:
        """Deliver a message of another client to the clients that have subscribed to its topic."""
        if retain:
            self.retained[topic] = content
        for client in self.clients:
            if topic in client.topics:
                client.heard.put_nowait(_message(topic, content, retain=False))

    def answer(self) -> None:
        """Answer the messages of QoS 1 that are not answered yet."""
        while self.unanswered:
            self.unanswered.pop(0)()

    def lose(self) -> None:
        """End all connections as a network does: the last wills are delivered."""
        for client in list(self.clients):
            client.end()

    def arrived(self, client: "FakeClient", topic: str, content: bytes, qos: int) -> bool:
        self.qualities.append((topic.split("/")[2], qos))
        if client not in self.clients:
            return False
        if self.loses_after is not None:
            self.loses_after -= 1
            if self.loses_after < 0:
                self.loses_after = None
                client.end()
                return False
        self.take(topic, content)
        self.taken += 1
        return True


class FakeClient:
    """As much of `aiomqtt.Client`, and of paho's below it, as a sink uses."""

    def __init__(self, broker: SparkplugBroker, will: aiomqtt.Will) -> None:
        self._broker, self._will = broker, will
        self.topics: set[str] = set()
        self.heard: asyncio.Queue[Any] = asyncio.Queue()
        self._disconnected: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._numbers = itertools.count(1)
        nothing = lambda *given: None  # noqa: E731
        self._client = SimpleNamespace(
            on_connect=nothing,
            on_publish=nothing,
            on_disconnect=nothing,
            publish=self._publish_below,
            disconnect=nothing,
            loop_write=nothing,
        )

    async def __aenter__(self) -> "FakeClient":
        if self._broker.is_down:
            raise aiomqtt.MqttError("of the test: the broker is down")
        self._client.on_connect(None, None, None, None, SimpleNamespace(MaximumPacketSize=self._broker.most))
        self._broker.clients.append(self)
        return self

    async def __aexit__(self, *exception: object) -> None:
        if self in self._broker.clients:
            self._broker.clients.remove(self)
            self._disconnected.set_result(None)

    def end(self) -> None:
        """The network ends this connection."""
        self._broker.clients.remove(self)
        self._disconnected.set_exception(aiomqtt.MqttError("of the test: lost"))
        self._disconnected.exception()
        self.heard.put_nowait(None)
        self._broker.take(self._will.topic, self._will.payload)  # type: ignore[arg-type]

    async def subscribe(self, topic: str, qos: int = 0, options: object = None) -> None:
        self._check()
        self.topics.add(topic)
        if topic in self._broker.retained:
            self.heard.put_nowait(_message(topic, self._broker.retained[topic], retain=True))

    async def publish(self, topic: str, content: bytes, qos: int, **_: object) -> None:
        self._check()
        self._broker.arrived(self, topic, content, qos)
        await asyncio.sleep(0)  # others have their turn, as they have where a socket is written

    def _publish_below(self, topic: str, content: bytes, qos: int, *_: object) -> SimpleNamespace:
        number = next(self._numbers)
        if self._broker.arrived(self, topic, content, qos):
            answer = SimpleNamespace(value=0)
            self._broker.unanswered.append(lambda: self._client.on_publish(None, None, number, answer))
            if not self._broker.is_mute:
                asyncio.get_running_loop().call_soon(self._broker.answer)
        return SimpleNamespace(rc=0, mid=number)

    def _check(self) -> None:
        if self._disconnected.done():
            raise aiomqtt.MqttError("of the test: not connected")

    @property
    def messages(self) -> AsyncIterator[Any]:
        return self._messages()

    async def _messages(self) -> AsyncIterator[Any]:
        while (message := await self.heard.get()) is not None:
            yield message
        raise aiomqtt.MqttError("of the test: lost")


def _message(topic: str, content: bytes, *, retain: bool) -> SimpleNamespace:
    return SimpleNamespace(topic=topic, payload=content, retain=retain)
