"""Request and response of the HTTP service, and the error that it answers by a status.

Knows what a resource gets and gives; knows no connection.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

HEAD_LIMIT: Final = 8192
"""Most bytes of request line and headers."""
BODY_LIMIT: Final = 4096
"""Most bytes of a request's body; no resource here needs a larger one."""


class HttpError(Exception):
    """Error that a resource raises to make the HTTP service answer with a status code and a sentence.

    Args:
        status: HTTP status code, such as 404.
        sentence: body of the response.
    """

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


@dataclass(frozen=True, slots=True)
class HttpRequest:
    """A request that the HTTP service has received.

    Attributes:
        method: ``GET``, ``POST``, …
        path: path of the resource, without the query.
        headers: value of each header, by name in lower case.
        body: at most `BODY_LIMIT` bytes.
    """

    method: str
    path: str
    headers: Mapping[str, str] = field(default_factory=dict)
    body: bytes = b""


@dataclass(frozen=True, slots=True)
class HttpResponse:
    """A response that the HTTP service sends.

    Attributes:
        body: the bytes of the body.
        content_type: value of the header ``Content-Type``.
        status: HTTP status code, 200 for success.
    """

    body: bytes
    content_type: str = "text/plain; charset=utf-8"
    status: int = 200
