"""Receives commands to write points by NATS request and reply.

Knows subjects and headers; the protocol is nats-py's (``busway[nats]``). The header ``by`` says who sends.

1. Plain subscription: the server keeps no commands while this collector is not connected.
2. The answer goes to the reply subject of the message; without one, or if it is a subject of commands, the command is
   executed and not answered.
3. Collectors of a fleet are a queue group: the server gives each message to one of them.
"""

import asyncio
import contextlib
import logging
import ssl
import time
from functools import partial
from importlib import import_module
from typing import Any

from ....extras import require
from ..cancellation import end_if_cancelled
from ..sinks.hidden_secrets import HiddenSecrets
from ..sinks.nats import subject_token
from ..sinks.nats_connection import nats_client_kind
from .command_messages import LONGEST_REQUEST, PAUSE, PAUSE_LIMIT, CommandMessageHandler, InputMessage, InputRights
from .message_tasks import MOST_AT_ONCE, MessageTasks

_log = logging.getLogger("busway.collector.commands")


class NatsCommands:
    """Receives commands to write points from a NATS server, and sends the answers.

    Args:
        url: ``nats://host:4222``.
        rights: the subject of commands, and the points that they may write.
        user, password, token: credentials for the server.
        tls: the TLS context; None for no encryption.
        timeout: seconds for connecting.

    Raises:
        MissingExtra: nats-py is not installed.
    """

    kind: str = "nats"
    separator: str = "."

    def __init__(
        self,
        url: str,
        rights: InputRights,
        *,
        user: str | None = None,
        password: str | None = None,
        token: str | None = None,
        tls: ssl.SSLContext | None = None,
        timeout: float = 5.0,
    ) -> None:
        require("nats", "commands by NATS")
        self.rights: InputRights = rights
        self._url, self._timeout = url, timeout
        self._secrets = HiddenSecrets(password, token)
        given = {"user": user, "password": password, "token": token, "tls": tls}
        self._options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        self._cause = ""
        self._group = ""

    def level(self, name: str) -> str:
        """Return a name as one token of a NATS subject: ``.``, ``*``, ``>`` and white space become ``_``."""
        return subject_token(name)

    def join(self, group: str, member: str) -> bool:
        """Join the queue group of a fleet's collectors; called before `run`.

        Args:
            group: the name of the queue group; empty if each collector gets all messages.
            member: the name of this collector.

        Returns:
            True if there is a group, so that each message goes to one collector only: ``group`` is not empty.
        """
        self._group = group
        return bool(group)

    async def run(self, handler: CommandMessageHandler) -> None:
        """Receive commands over NATS, have ``handler`` execute them, and send the answers, until cancelled.

        A lost connection is opened again after growing pauses; the status of ``handler`` shows the error.
        """
        nats = import_module("nats")
        wait = PAUSE
        while True:
            ended, client = asyncio.Event(), nats_client_kind()()
            client.must_encrypt = "tls" in self._options or self._url.startswith("tls:")
            self._cause = ""
            try:
                await client.connect(
                    self._url,
                    allow_reconnect=False,
                    max_reconnect_attempts=1,  # 0 would try for ever
                    reconnect_time_wait=0.1,
                    connect_timeout=self._timeout,
                    error_cb=self._note,
                    closed_cb=_setter(ended),
                    disconnected_cb=_setter(ended),
                    **self._options,
                )
                async with MessageTasks() as tasks:
                    await self._subscribe(client, tasks, handler)
                    handler.connected()
                    wait = PAUSE
                    end_if_cancelled()
                    await ended.wait()
                handler.down(f"the server has closed the connection {self._cause}".rstrip())
            except (nats.errors.Error, OSError, TimeoutError) as error:
                handler.down(f"the server cannot be used: {self._cause or self._words(error)}")
            finally:
                if client.is_connecting or client.is_connected:  # also where connecting failed or was given up
                    with contextlib.suppress(nats.errors.Error, OSError, TimeoutError):  # it may be gone already
                        await client.close()
            end_if_cancelled()
            await asyncio.sleep(wait)
            wait = min(2 * wait, PAUSE_LIMIT)

    async def _note(self, error: Exception) -> None:
        """Remember the text of an error, to be shown as the cause when connecting fails or the connection ends.

        Called by the NATS library (``error_cb``), because the error that its `connect` raises does not name the cause.
        """
        self._cause = self._words(error)

    def _words(self, error: Exception) -> str:
        return self._secrets.hide(error) or type(error).__name__

    async def _subscribe(self, client: Any, tasks: MessageTasks, handler: CommandMessageHandler) -> None:
        async def came(message: Any) -> None:
            if not tasks.begin(partial(self._handle, message, handler, time.monotonic())):
                handler.drop(message.subject)

        wildcards = self.rights.where.replace("{device}", "*").replace("{point}", "*")
        await client.subscribe(
            wildcards,
            queue=self._group,
            cb=came,
            pending_msgs_limit=4 * MOST_AT_ONCE,
            pending_bytes_limit=8 * MOST_AT_ONCE * LONGEST_REQUEST,
        )
        # The library sends the PING of a flush at once, the subscription in the next turn of the event loop: the answer
        # to the first PING says nothing of the subscription, the answer to the second comes after it.
        await client.flush()
        await client.flush()

    async def _handle(self, message: Any, handler: CommandMessageHandler, arrived: float) -> None:
        by = (message.headers or {}).get("by", "")
        answer = await handler.handle(InputMessage(message.subject, message.data, by=by, arrived=arrived))
        if answer is None or not message.reply or handler.is_for_commands(message.reply):
            return
        try:
            await message.respond(answer)
        except (import_module("nats").errors.Error, OSError) as error:
            _log.warning("an answer to a command could not be sent: %s", error)


def _setter(event: asyncio.Event) -> Any:  # what the library calls
    async def told() -> None:
        event.set()

    return told
