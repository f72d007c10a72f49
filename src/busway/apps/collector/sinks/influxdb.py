"""Sink for InfluxDB line protocol over HTTP: InfluxDB 1 to 3, VictoriaMetrics, QuestDB.

Knows lines and what the answers mean; the protocol is httpx's (``busway[influxdb]``).

1. A line is ``measurement,device=…,point=… value=…,reason=…i time``. Tags and time are the key, so a line that comes
   again replaces itself. Texts are in the field ``text``: a field has one type. A bad sample has ``reason`` alone.
2. 400, 413 and 422 are refusals of these lines; any other error is one of the server, or of the credentials, and is
   waited out.
"""

import math
import ssl
from collections.abc import Sequence
from importlib import import_module
from typing import Any, Final

from ....errors import ConfigError
from ....extras import require
from ....options.sinks import InfluxOptions
from ..store.committed_samples import CommittedSample
from .interface import SinkDown, SinkRefused

_USUAL: Final = InfluxOptions()
_REFUSED: Final = (400, 413, 422)


class InfluxSink:
    """Sink that posts samples over HTTP in InfluxDB line protocol."""

    def __init__(
        self,
        url: str,
        *,
        measurement: str = _USUAL.measurement,
        token: str | None = None,
        tls: ssl.SSLContext | None = None,
        timeout: float = 10.0,
    ) -> None:
        """Set the server of the database; nothing is sent yet.

        Args:
            url: where lines are posted, with its query: ``http://host:8086/api/v2/write?org=o&bucket=b`` or
                ``http://host:8428/write``. ``precision=ns`` is added.
            measurement: the measurement of all lines.
            token: sent as ``Authorization: Token …``.
            tls: how to encrypt ``https``; None for the system's authorities.
            timeout: seconds for each request.

        Raises:
            ConfigError: the URL is not of HTTP.
            MissingExtra: httpx is not installed.
        """
        require("httpx", "a sink to InfluxDB")
        if not url.startswith(("http://", "https://")):
            raise ConfigError(f"lines are posted to http:// or https://, not {url!r}", key="url")
        self._url = url + ("" if "precision=" in url else ("&" if "?" in url else "?") + "precision=ns")
        self._measurement = _escaped(measurement, ", ")
        self._headers = {} if token is None else {"Authorization": f"Token {token}"}
        self._tls, self._timeout = tls, timeout
        self._client: Any = None  # httpx is loaded when it is used

    async def open(self) -> None:
        """Create the HTTP client; it connects with the first batch."""
        verify: Any = True if self._tls is None else self._tls
        self._client = import_module("httpx").AsyncClient(
            headers=self._headers, verify=verify, timeout=self._timeout, trust_env=False
        )

    async def close(self) -> None:
        """Disconnect from the database server."""
        client, self._client = self._client, None
        if client is not None:
            await client.aclose()

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Post samples to the database. Raises `SinkDown`, `SinkRefused`."""
        httpx = import_module("httpx")
        body = "\n".join(line_of(sample, self._measurement) for sample in samples).encode()
        try:
            answer = await self._client.post(self._url, content=body)
        except httpx.HTTPError as error:
            raise SinkDown(f"the server cannot be reached: {error or type(error).__name__}") from error
        if answer.status_code in _REFUSED:
            raise SinkRefused(f"the server answered {answer.status_code}: {answer.text[:200]}")
        if not answer.is_success:
            raise SinkDown(f"the server answered {answer.status_code}: {answer.text[:200]}")


def line_of(sample: CommittedSample, measurement: str) -> str:
    """Return a sample in line protocol; ``measurement`` is escaped already."""
    fields = [f"reason={sample.reason}i"]
    value = sample.value
    if isinstance(value, str):
        quoted = value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
        fields.insert(0, f'text="{quoted}"')
    elif value is not None and math.isfinite(value):
        fields.insert(0, f"value={float(value)!r}")
    device, point = _escaped(sample.device, ",= "), _escaped(sample.point, ",= ")
    return f"{measurement},device={device},point={point} {','.join(fields)} {sample.time}"


def _escaped(text: str, characters: str) -> str:
    text = text.replace("\\", "\\\\").replace("\n", "\\n")
    for each in characters:
        text = text.replace(each, f"\\{each}")
    return text
