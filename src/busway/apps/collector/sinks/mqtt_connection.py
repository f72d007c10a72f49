"""Connects MQTT clients (aiomqtt), closes connections that cannot be used, and publishes with the broker's answer.

Knows the library's client and that of paho below it; knows no topic.

1. If a client gets no answer while it connects, or is cancelled, the library leaves its socket and a task open. Here
   `connect` closes both.
2. The thread in which a client connects cannot be stopped: if connecting fails or is cancelled, `connect` waits for it,
   for at most `GIVE_UP_SECONDS`.
3. The library takes each acknowledgement for a success, even one that says that the message was thrown away. Here such
   an answer is an error: `SinkRefused` for a message that can never be taken, `SinkDown` if the broker, its rights or
   its quota can change.
4. A message above the size that a broker has announced is not sent. A broker that has announced none may close the
   connection at a large message, or answer in a way that paho takes for a broken protocol; then that message counts as
   refused.
"""

import asyncio
from importlib import import_module
from typing import Any, Final

from .interface import SinkDown, SinkRefused

GIVE_UP_SECONDS: Final = 0.5
REFUSED: Final = frozenset({0x90, 0x95, 0x99})
"""Reason codes of a message that can never be taken: topic, size, format of payload (MQTT 5.0 §3.4.2.1, §3.14.2.1)."""
_PROTOCOL_ERROR: Final = 0x82
_LEAST_SUSPECT: Final = 1024
"""Bytes of payload from which on the size of a message can be the reason why the broker ended the connection."""


async def connect(client: Any) -> None:  # aiomqtt is loaded when it is used
    """Connect an MQTT client to its broker; ``client.__aexit__`` disconnects it.

    Raises:
        aiomqtt.MqttError, OSError: the client is not connected, and nothing of it is left open.
    """
    connecting = asyncio.ensure_future(client.__aenter__())
    try:
        await asyncio.shield(connecting)
    except BaseException:
        await asyncio.wait([connecting], timeout=GIVE_UP_SECONDS)
        below = client._client  # paho's: the library's own disconnecting waits for a connection that there never was
        below.disconnect()
        below.loop_write()  # which closes the socket
        connecting.cancel()
        await asyncio.wait([connecting])
        raise


class MqttPublisher:
    """Publishes messages over one connection of an MQTT client, and waits for the broker's answers.

    It replaces the client's callbacks for connecting, acknowledgements and disconnecting by its own, which call those
    of the client; an acknowledgement that is awaited here is not passed on.

    Args:
        client: a client of aiomqtt, not connected yet.
        timeout: seconds for an answer.
    """

    def __init__(self, client: Any, timeout: float) -> None:
        self._client, self._below, self._timeout = client, client._client, timeout
        self._most: int | None = None
        self._end = 0
        self._answers: dict[int, asyncio.Future[Any]] = {}
        self._told = (self._below.on_connect, self._below.on_publish, self._below.on_disconnect)
        self._below.on_connect, self._below.on_publish = self._on_connect, self._on_publish
        self._below.on_disconnect = self._on_disconnect

    @property
    def has_ended(self) -> bool:
        """Whether the connection to the MQTT broker has ended."""
        return bool(self._client._disconnected.done())

    def check_size(self, topic: str, payload: bytes, properties: Any = None) -> None:
        """Raise `SinkRefused` if a message is larger than the limit that the broker has announced, if it has any."""
        told = 1 if properties is None else len(properties.pack())
        size = 5 + 2 + len(topic.encode()) + 2 + told + len(payload)
        if self._most is not None and size > self._most:
            raise SinkRefused(f"a message has {size} bytes, and the broker takes at most {self._most}")

    async def publish(self, topic: str, payload: bytes, *, retain: bool = False, properties: Any = None) -> int:
        """Publish a message with QoS 1, and wait for the broker's answer.

        Returns:
            The reason code of the answer (MQTT 5.0 §3.4.2.1), 0…255; 0x80 and more: the broker threw the message away.

        Raises:
            SinkRefused: the message is too large for this broker, or seems to be: then the connection has ended.
            aiomqtt.MqttError: no answer came, or the message could not be sent; it may have arrived.
        """
        mqtt = import_module("aiomqtt")
        self.check_size(topic, payload, properties)
        info = self._below.publish(topic, payload, 1, retain, properties)
        if info.rc != 0:
            raise mqtt.MqttCodeError(info.rc, "could not publish a message")
        answer = self._answers[info.mid] = asyncio.get_running_loop().create_future()
        try:
            ends = {answer, self._client._disconnected}
            await asyncio.wait(ends, timeout=self._timeout, return_when=asyncio.FIRST_COMPLETED)
            if answer.done():
                return int(answer.result())
            if not self.has_ended:
                raise mqtt.MqttError(f"no acknowledgement within {self._timeout:g} s")
            if self._end in (0x95, _PROTOCOL_ERROR) and len(payload) >= _LEAST_SUSPECT:
                raise SinkRefused(f"the broker ended the connection at a message of {len(payload)} bytes")
            raise mqtt.MqttError("the connection was lost")
        finally:
            del self._answers[info.mid]

    async def publish_taken(self, topic: str, payload: bytes, *, retain: bool = False, properties: Any = None) -> None:
        """Publish a message with QoS 1, and wait until the broker has accepted it.

        Raises:
            SinkRefused: the broker refuses the message for good.
            SinkDown: the broker has answered that it does not accept the message now.
            aiomqtt.MqttError: no answer came, or the message could not be sent; it may have arrived.
        """
        answer = await self.publish(topic, payload, retain=retain, properties=properties)
        if answer >= 0x80:
            kind = SinkRefused if answer in REFUSED else SinkDown
            raise kind(f"the broker did not take a message on {topic}: {_words(answer)}")

    def _on_connect(self, *given: Any) -> Any:  # as paho calls it
        properties = given[4] if len(given) > 4 else None
        self._most = getattr(properties, "MaximumPacketSize", None)
        return self._told[0](*given)

    def _on_publish(self, *given: Any) -> Any:  # as paho calls it
        answer = self._answers.get(given[2])
        if answer is None:
            return self._told[1](*given)
        if not answer.done():
            answer.set_result(given[3].value)
        return None

    def _on_disconnect(self, *given: Any) -> Any:  # as paho calls it
        self._end = given[3].value
        return self._told[2](*given)


def _words(answer: int) -> str:
    """Return the meaning of a reason code in a broker's answer to a message, as text."""
    codes = import_module("paho.mqtt.reasoncodes")
    kinds = import_module("paho.mqtt.packettypes").PacketTypes
    try:
        return f"{codes.ReasonCode(kinds.PUBACK, identifier=answer)}"
    except (KeyError, ValueError):
        return f"reason {answer}"
