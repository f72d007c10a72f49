"""Sink that publishes samples to a stream of NATS JetStream.

Knows subjects and messages; the protocol is nats-py's (``busway[nats]``).

1. A message is one device and commit (`documents`). If it is sent again, its ``Nats-Msg-Id`` is the same, so that the
   server drops a repetition within its window (two minutes by default).
2. `send` returns when the stream has acknowledged every message.
3. Alarm events go to one subject: ``alarms`` after the part of the subject that stands before ``{device}``, such as
   ``busway.alarms``.
4. With the option ``stream``, that stream is created if it is missing. Without it, a stream with the subjects must
   exist already.
"""

import contextlib
import re
import ssl
from collections.abc import Sequence
from importlib import import_module
from typing import Any, Final

from ....errors import ConfigError
from ....extras import require
from ....options.sinks import NatsOptions
from ..store.committed_samples import CommittedAlarm, CommittedSample
from .documents import alarm_document, documents
from .hidden_secrets import HiddenSecrets
from .interface import SinkDown, SinkRefused, all_taken
from .nats_connection import nats_client_kind

_USUAL: Final = NatsOptions()
IN_FLIGHT: Final = 64
"""Messages that are sent together; the next ones are sent when all of these are acknowledged."""
REFUSED: Final = frozenset({10054})
"""Error codes of JetStream for a message that can never be taken: it is larger than the stream permits."""
_HEADER_BYTES: Final = len("NATS/1.0\r\nNats-Msg-Id: \r\n\r\n")


class NatsSink:
    """Sink that publishes samples and alarm events to a stream of NATS JetStream."""

    def __init__(
        self,
        url: str,
        *,
        subject: str = _USUAL.subject,
        stream: str | None = None,
        user: str | None = None,
        password: str | None = None,
        token: str | None = None,
        tls: ssl.SSLContext | None = None,
        timeout: float = 5.0,
    ) -> None:
        """Set the NATS server and options of the sink; nothing is sent yet.

        Args:
            url: ``nats://host:4222``.
            subject: the subject of samples, with ``{device}``.
            stream: name of a stream that is created for the subjects of this sink if it is missing; None to create no
                stream.
            user, password, token: credentials for the server.
            tls: the TLS context; None for no encryption.
            timeout: seconds for connecting, and for an acknowledgement.

        Raises:
            ConfigError: the subject lacks ``{device}`` or has wildcards.
            MissingExtra: nats-py is not installed.
        """
        require("nats", "a sink to NATS")
        if "{device}" not in subject or "*" in subject or ">" in subject:
            raise ConfigError(f"a subject has {{device}} and no wildcards, not {subject!r}", key="subject")
        before = subject.partition("{")[0].rstrip(".")
        self._alarm_subject = f"{before}.alarms" if before else "alarms"
        self._url, self._subject, self._stream, self._timeout = url, subject, stream, timeout
        given = {"user": user, "password": password, "token": token, "tls": tls}
        self._options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        self._secrets = HiddenSecrets(password, token)
        self._client: Any = None  # nats-py is loaded when it is used
        self._jetstream: Any = None
        self._cause = ""

    def own_topic(self, device: str, point: str) -> str:
        """Return the subject for samples of a device if it is that of alarm events; else an empty text."""
        subject = self._subject.replace("{device}", subject_token(device))
        return subject if subject == self._alarm_subject else ""

    async def open(self) -> None:
        """Connect to the NATS server, and create the configured stream if it is missing.

        Raises:
            SinkDown: the server cannot be used, has no JetStream, or cannot create the stream.
        """
        nats = import_module("nats")
        self._cause = ""
        self._client = nats_client_kind()()  # `close` ends it also where connecting fails or is given up
        self._client.must_encrypt = "tls" in self._options or self._url.startswith("tls:")
        try:
            await self._client.connect(
                self._url,
                allow_reconnect=False,
                max_reconnect_attempts=1,  # 0 would try for ever
                reconnect_time_wait=0.1,
                connect_timeout=self._timeout,
                error_cb=self._note,
                **self._options,
            )
            self._jetstream = self._client.jetstream(timeout=self._timeout)
            # The library prepares replies with the first request: it is this one, so that messages keep their order.
            await self._jetstream.account_info()
            if self._stream is not None:
                await self._make_stream(self._stream)
        except (nats.errors.Error, OSError, TimeoutError) as error:
            raise SinkDown(f"the server cannot be used: {self._cause or self._words(error)}") from error

    def _words(self, error: Exception) -> str:
        return self._secrets.hide(error) or type(error).__name__

    async def _note(self, error: Exception) -> None:
        """Keep the text of an error as the cause to be shown if connecting fails.

        Called by the NATS library (``error_cb``), because the error that its `connect` raises does not name the cause.
        """
        self._cause = self._words(error)

    async def _make_stream(self, stream: str) -> None:
        missing = import_module("nats.js.errors").NotFoundError
        try:
            await self._jetstream.stream_info(stream)
        except missing:
            subjects = [self._subject.replace("{device}", "*")]
            if not self._subject.endswith("{device}") or self._subject.count(".") != self._alarm_subject.count("."):
                subjects.append(self._alarm_subject)
            await self._jetstream.add_stream(name=stream, subjects=subjects)

    async def close(self) -> None:
        """Disconnect from the NATS server."""
        client, self._client, self._jetstream = self._client, None, None
        if client is not None and (client.is_connecting or client.is_connected):
            with contextlib.suppress(import_module("nats").errors.Error, OSError, TimeoutError):  # it may be gone
                await client.close()

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Publish samples, and wait until the stream has acknowledged them.

        Raises:
            SinkDown: the server does not accept messages now, or no stream has the subject; some samples may have
                arrived.
            SinkRefused: a message is too large.
        """
        messages = [
            (self._subject.replace("{device}", subject_token(each.device)), each.encode(), each.key)
            for each in documents(samples)
        ]
        await self._publish(messages)

    async def send_alarms(self, alarms: Sequence[CommittedAlarm]) -> None:
        """Publish alarm events, and wait until the stream has acknowledged them.

        Raises:
            SinkDown: the server or the stream does not accept messages now; some events may have arrived.
            SinkRefused: an event is too large, or no stream has the subject of alarm events.
        """
        no_stream = import_module("nats.js.errors").NoStreamResponseError
        try:
            await self._publish(
                [(self._alarm_subject, each.encode(), each.key) for each in map(alarm_document, alarms)]
            )
        except SinkDown as error:
            if isinstance(error.__cause__, no_stream):
                raise SinkRefused(f"no stream has the subject {self._alarm_subject}") from error
            raise

    async def _publish(self, messages: Sequence[tuple[str, bytes, str]]) -> None:
        """Publish messages, and wait until the stream has acknowledged them all.

        Args:
            messages: subject, payload and key (``Nats-Msg-Id``) of each; the stream recognises repeated messages by the
                key.

        Raises:
            SinkRefused: a message is too large for the server or the stream. Some of the messages may have arrived.
            SinkDown: the server or the stream does not accept messages now. Some of the messages may have arrived.
        """
        nats = import_module("nats")
        if self._client is None or self._jetstream is None:
            raise SinkDown("the server is not connected")
        try:
            for _, payload, key in messages:
                self._check_size(payload, key)
            for begin in range(0, len(messages), IN_FLIGHT):
                await all_taken(
                    self._jetstream.publish(subject, payload, headers={"Nats-Msg-Id": key})
                    for subject, payload, key in messages[begin : begin + IN_FLIGHT]
                )
        except import_module("nats.js.errors").APIError as error:
            if error.err_code in REFUSED:
                raise SinkRefused(f"the stream refuses: {error.description}") from error
            raise SinkDown(f"the stream does not take messages: {error.description}") from error
        except (nats.errors.Error, OSError, TimeoutError) as error:
            raise SinkDown(f"the stream does not acknowledge: {self._words(error)}") from error

    def _check_size(self, payload: bytes, key: str) -> None:
        size = len(payload) + len(key.encode()) + _HEADER_BYTES
        most = int(self._client.max_payload)
        if size > most:
            raise SinkRefused(f"a message has {size} bytes, and the server takes at most {most}")


def subject_token(name: str) -> str:
    """Return a name as one token of a NATS subject: ``.``, ``*``, ``>`` and white space become ``_``."""
    return re.sub(r"[.*>\s]", "_", name)
