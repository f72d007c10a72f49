"""Sink for InfluxDB line protocol over HTTP: InfluxDB 1 to 3, VictoriaMetrics, QuestDB.

Knows lines and what the answers mean; the protocol is httpx's (``busway[influxdb]``).

1. A line is ``measurement,device=…,point=… value=…,reason=…i time``. Tags and time are the key, so a line that comes
   again replaces itself. Texts are in the field ``text``: a field has one type. Without a value, there is only
   ``reason``.
2. A line of an event of an alarm is ``alarms,device=…,point=…,limit=H,event=raised commit=…i,place=…i,value=… time``,
   with the fields ``text`` and ``by``: its tags and time are its key too. A value that is a text is in ``value_text``.
3. 400, 413 and 422 mean that these lines are refused. Any other error is one of the server or of the credentials, and
   the lines are sent again later.
"""

import math
import ssl
from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import Any, Final

from ....errors import ConfigError
from ....extras import require
from ....options.sinks import InfluxOptions
from ..store.committed_samples import CommittedAlarm, CommittedSample
from .hidden_secrets import HiddenSecrets
from .interface import SinkDown, SinkRefused

_USUAL: Final = InfluxOptions()
_REFUSED: Final = (400, 413, 422)


class InfluxSink:
    """Sink that posts samples and alarm events over HTTP in InfluxDB line protocol."""

    def __init__(
        self,
        url: str,
        *,
        measurement: str = _USUAL.measurement,
        alarm_measurement: str = _USUAL.alarm_measurement,
        token: str | None = None,
        tls: ssl.SSLContext | None = None,
        timeout: float = 10.0,
    ) -> None:
        """Set the database server and options of the sink; nothing is sent yet.

        Args:
            url: where lines are posted, with its query: ``http://host:8086/api/v2/write?org=o&bucket=b`` or
                ``http://host:8428/write``. ``precision=ns`` is added unless the URL has a precision.
            measurement: name of the measurement of samples.
            alarm_measurement: name of the measurement of alarm events.
            token: sent as ``Authorization: Token …``; None for none.
            tls: the TLS context for ``https``; None for one that trusts the system's authorities.
            timeout: seconds for each request.

        Raises:
            ConfigError: the URL is not of HTTP.
            MissingExtra: httpx is not installed.
        """
        require("httpx", "a sink to InfluxDB")
        if not url.startswith(("http://", "https://")):
            raise ConfigError(f"lines are posted to http:// or https://, not {url!r}", key="url")
        self._url = url + ("" if "precision=" in url else ("&" if "?" in url else "?") + "precision=ns")
        self._measurement, self._alarm_measurement = _escaped(measurement, ", "), _escaped(alarm_measurement, ", ")
        self._secrets = HiddenSecrets(token)
        self._headers = {} if token is None else {"Authorization": f"Token {token}"}
        self._tls, self._timeout = tls, timeout
        self._client: Any = None  # httpx is loaded when it is used

    async def open(self) -> None:
        """Create the HTTP client. Nothing is sent: it connects with the first batch."""
        verify: Any = True if self._tls is None else self._tls
        self._client = import_module("httpx").AsyncClient(
            headers=self._headers, verify=verify, timeout=self._timeout, trust_env=False
        )

    async def close(self) -> None:
        """Close the HTTP client, and with it the connections to the database server."""
        client, self._client = self._client, None
        if client is not None:
            await client.aclose()

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Post samples to the database; when it returns, the server has accepted them.

        Raises:
            SinkDown: the server cannot be reached, or answers with another error; samples may have arrived.
            SinkRefused: the server refuses the lines (400, 413, 422).
        """
        await self._post(line_of(sample, self._measurement) for sample in samples)

    async def send_alarms(self, alarms: Sequence[CommittedAlarm]) -> None:
        """Post alarm events to the database; when it returns, the server has accepted them.

        Raises errors like `send`.
        """
        await self._post(alarm_line_of(alarm, self._alarm_measurement) for alarm in alarms)

    async def _post(self, lines: Iterable[str]) -> None:
        httpx = import_module("httpx")
        try:
            answer = await self._client.post(self._url, content="\n".join(lines).encode())
        except httpx.HTTPError as error:
            raise SinkDown(f"the server cannot be reached: {str(error) or type(error).__name__}") from error
        if not answer.is_success:
            kind = SinkRefused if answer.status_code in _REFUSED else SinkDown
            raise kind(f"the server answered {answer.status_code}: {self._secrets.hide(answer.text)[:200]}")


def line_of(sample: CommittedSample, measurement: str) -> str:
    """Return a sample as one line of InfluxDB line protocol, with its time in nanoseconds.

    A text is in the field ``text``. Without a value, or with NaN or an infinity, the line has the field ``reason``
    alone.

    Args:
        sample: the sample.
        measurement: name of the measurement, escaped already.
    """
    value = f"text={_quoted(sample.value)}" if isinstance(sample.value, str) else _number(sample.value)
    device, point = _escaped(sample.device, ",= "), _escaped(sample.point, ",= ")
    fields = f"{value},reason={sample.reason}i" if value else f"reason={sample.reason}i"
    return f"{measurement},device={device},point={point} {fields} {sample.time}"


def alarm_line_of(alarm: CommittedAlarm, measurement: str) -> str:
    """Return an alarm event as one line of InfluxDB line protocol, with its time in nanoseconds.

    Args:
        alarm: the alarm event.
        measurement: name of the measurement, escaped already.
    """
    event = alarm.event
    named = {"device": event.device, "point": event.point, "limit": event.limit, "event": event.kind.value}
    tags = ",".join(f"{key}={_escaped(value, ',= ')}" for key, value in named.items())
    value = f"value_text={_quoted(event.value)}" if isinstance(event.value, str) else _number(event.value)
    texts = [f"text={_quoted(event.text)}", f"by={_quoted(event.by)}"]
    fields = [f"commit={alarm.commit}i", f"place={alarm.place}i", *([value] if value else []), *texts]
    return f"{measurement},{tags} {','.join(fields)} {event.at}"


def _number(value: float | None) -> str:
    """Return the field ``value=…`` of line protocol for a number; empty for None, NaN and infinities."""
    return f"value={float(value)!r}" if value is not None and math.isfinite(value) else ""


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'


def _escaped(text: str, characters: str) -> str:
    text = text.replace("\\", "\\\\").replace("\n", "\\n")
    for each in characters:
        text = text.replace(each, f"\\{each}")
    return text
