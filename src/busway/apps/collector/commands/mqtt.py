"""Receives commands to write points from an MQTT 5 broker.

Knows topics and properties; the protocol is aiomqtt's (``busway[mqtt]``).

1. The session is clean: a broker keeps no commands while this collector is not connected.
2. The answer goes to the response topic of the message, with its correlation data; without one, to the topic of the
   command with ``/result`` behind it. No answer goes to a topic of commands, or to one that has wildcards or
   begins with ``$``.
3. Collectors of a fleet share their subscription: the broker gives each message to one of them. It has QoS 0, because
   the broker may give to another collector what one has not acknowledged at the end of its connection.
4. Messages that the broker has retained are not asked for. A message that is published with the retain flag while this
   collector is connected arrives with the flag, and is refused.
"""

import asyncio
import contextlib
import logging
import ssl
import time
from collections.abc import AsyncIterator
from functools import partial
from importlib import import_module
from typing import Any, Final

from ....extras import require
from ..cancellation import end_if_cancelled
from ..sinks.mqtt import topic_level
from ..sinks.mqtt_connection import connect
from .command_messages import LONGEST_REQUEST, PAUSE, PAUSE_LIMIT, CommandMessageHandler, InputMessage, InputRights
from .message_tasks import MOST_AT_ONCE, MessageTasks

_LONGEST_TOPIC: Final = 500
_log = logging.getLogger("busway.collector.commands")


class MqttCommands:
    """Receives commands to write points from an MQTT broker, and publishes the answers.

    Args:
        host, port: the broker.
        rights: the topic of commands, and the points that they may write.
        user, password: credentials for the broker.
        tls: the TLS context; None for no encryption.
        client_id: names this client to the broker; None for one that the library makes.
        timeout: seconds for connecting, and for an acknowledgement.

    Raises:
        MissingExtra: aiomqtt is not installed.
    """

    kind: str = "mqtt"
    separator: str = "/"

    def __init__(
        self,
        host: str,
        port: int,
        rights: InputRights,
        *,
        user: str | None = None,
        password: str | None = None,
        tls: ssl.SSLContext | None = None,
        client_id: str | None = None,
        timeout: float = 10.0,
    ) -> None:
        require("aiomqtt", "commands by MQTT")
        self.rights: InputRights = rights
        self._where = f"{host}:{port}"
        self._address: dict[str, Any] = {"hostname": host, "port": port, "username": user, "password": password}
        self._address |= {"tls_context": tls, "identifier": client_id, "timeout": timeout}
        self._group = ""

    def level(self, name: str) -> str:
        """Return a name as one level of an MQTT topic: ``/``, ``+``, ``#`` and the character 0 become ``_``."""
        return topic_level(name)

    def join(self, group: str, member: str) -> bool:
        """Share the subscription with the other collectors of a fleet; called before `run`.

        Args:
            group: the name under which the collectors share messages; empty if each collector gets all of them.
            member: the name of this collector; it is added to the client identifier, if that was given.

        Returns:
            True if the subscription is shared, so that each message goes to one collector only: ``group`` is not empty.
        """
        self._group = group
        if self._address["identifier"] is not None:  # a broker ends a connection when another one has its name
            self._address["identifier"] += f"-{member}"
        return bool(group)

    async def run(self, handler: CommandMessageHandler) -> None:
        """Receive commands over MQTT, have ``handler`` execute them, and publish the answers, until cancelled.

        A lost connection is opened again after growing pauses; the status of ``handler`` shows the error.
        """
        mqtt = import_module("aiomqtt")
        wait = PAUSE
        while True:
            try:
                async with _connected(self._client(mqtt)) as client, MessageTasks() as tasks:
                    await self._subscribe(client)
                    handler.connected()
                    wait = PAUSE
                    end_if_cancelled()
                    await self._receive(client, tasks, handler)
            except (mqtt.MqttError, OSError) as error:
                handler.down(f"the broker {self._where} cannot be reached: {error}")
            end_if_cancelled()
            await asyncio.sleep(wait)
            wait = min(2 * wait, PAUSE_LIMIT)

    def _client(self, mqtt: Any) -> Any:  # the library is loaded when it is used
        properties = import_module("paho.mqtt.properties").Properties(
            import_module("paho.mqtt.packettypes").PacketTypes.CONNECT
        )
        properties.SessionExpiryInterval = 0
        properties.ReceiveMaximum = MOST_AT_ONCE
        properties.MaximumPacketSize = 2 * LONGEST_REQUEST
        return mqtt.Client(
            **self._address,
            protocol=mqtt.ProtocolVersion.V5,
            clean_start=True,
            properties=properties,
            max_queued_incoming_messages=4 * MOST_AT_ONCE,
        )

    async def _subscribe(self, client: Any) -> None:
        shared = bool(self._group)
        options = import_module("paho.mqtt.subscribeoptions").SubscribeOptions(
            qos=0 if shared else 1, noLocal=not shared, retainAsPublished=True, retainHandling=2
        )
        wildcards = self.rights.where.replace("{device}", "+").replace("{point}", "+")
        codes = await client.subscribe(f"$share/{self._group}/{wildcards}" if shared else wildcards, options=options)
        if any(code.is_failure for code in codes):
            raise OSError(f"it refuses the subscription: {codes[0]}")

    async def _receive(self, client: Any, tasks: MessageTasks, handler: CommandMessageHandler) -> None:
        async for message in client.messages:
            if not tasks.begin(partial(self._handle, client, message, handler, time.monotonic())):
                handler.drop(str(message.topic))

    async def _handle(self, client: Any, message: Any, handler: CommandMessageHandler, arrived: float) -> None:
        properties = message.properties
        where = str(message.topic)
        payload = message.payload if isinstance(message.payload, bytes) else b""
        answer = await handler.handle(
            InputMessage(
                where,
                payload,
                by=dict(getattr(properties, "UserProperty", ())).get("by", ""),
                seconds_left=getattr(properties, "MessageExpiryInterval", None),
                is_retained=bool(message.retain),
                arrived=arrived,
            )
        )
        if answer is None:
            return
        try:
            await self._answer(client, where, properties, answer, handler)
        except (import_module("aiomqtt").MqttError, OSError, ValueError) as error:  # ValueError: no topic
            _log.warning("an answer to a command could not be sent: %s", error)

    @staticmethod
    async def _answer(client: Any, where: str, properties: Any, answer: bytes, handler: CommandMessageHandler) -> None:
        topic = getattr(properties, "ResponseTopic", None) or f"{where}/result"
        if handler.is_for_commands(topic) or len(topic) > _LONGEST_TOPIC or topic[0] == "$" or set(topic) & set("+#"):
            _log.warning("nothing is answered on %.100r, which is no topic for answers", topic)
            return
        sent = import_module("paho.mqtt.properties").Properties(
            import_module("paho.mqtt.packettypes").PacketTypes.PUBLISH
        )
        if hasattr(properties, "CorrelationData"):
            sent.CorrelationData = properties.CorrelationData
        sent.ContentType = "application/json"
        await client.publish(topic, answer, qos=1, retain=False, properties=sent)


@contextlib.asynccontextmanager
async def _connected(client: Any) -> AsyncIterator[Any]:  # the library's own
    """Return a context manager that connects an MQTT client with `connect`, and disconnects it at the end."""
    await connect(client)
    try:
        yield client
    finally:
        await client.__aexit__(None, None, None)
