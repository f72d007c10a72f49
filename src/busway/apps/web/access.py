"""Access to the page: Host, Origin, token and size of every request, checked before the application sees it.

Knows headers and sizes; knows no resource. It wraps the whole application, HTTP and WebSocket.

1. On loopback no token is needed, but the ``Host`` must be a loopback name: a foreign name that resolves to 127.0.0.1
   (DNS rebinding) is refused.
2. Pages of another origin are refused, by ``Origin`` and by ``Sec-Fetch-Site``. Requests that change something must be
   JSON, which such a page cannot send without asking first.
3. Elsewhere each request to the API carries the token, in ``Authorization: Bearer …``; a WebSocket, for which a browser
   sets no such header, as its subprotocol ``bearer.…``. It is never part of a URL, which would end up in logs.
   The page itself holds no secret and needs no token.
4. Tokens are compared in constant time.
"""

import hmac
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from typing import Any, Final

from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse

from ..control.addresses import is_loopback

Scope = MutableMapping[str, Any]  # Any: as ASGI has them
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

BODY_LIMIT: Final = 4 * 1024 * 1024
"""Bytes of a request: room for a hundred thousand values."""
BEARER_PROTOCOL: Final = "bearer."
POLICY_VIOLATION: Final = 1008
"""Close code of a WebSocket that is refused (RFC 6455 §7.4.1)."""
_CHANGING: Final = frozenset({"POST", "PUT", "PATCH", "DELETE"})


@dataclass(frozen=True, slots=True)
class PageAccessRules:
    """Rules of one listener.

    Attributes:
        token: required token; empty if none is needed.
        is_loopback: whether it can be reached from this host alone.
    """

    token: str = ""
    is_loopback: bool = True


class Refused(HTTPException):
    """A request that goes no further: a status and a sentence."""


class PageAccess:
    """ASGI middleware that refuses requests against the rules.

    Args:
        inner: the application.
        rules: rules of the listener.
        is_open: whether a path needs no token.
    """

    def __init__(self, inner: Application, rules: PageAccessRules, is_open: Callable[[str], bool]) -> None:
        self._inner = inner
        self._rules = rules
        self._is_open = is_open

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._inner(scope, receive, send)
            return
        headers = _headers(scope)
        try:
            self._check(scope, headers)
            if scope["type"] == "http":
                receive = _bounded(receive, headers)
            await self._inner(scope, receive, send)
        except Refused as error:
            await _refuse(error, scope, receive, send)

    def _check(self, scope: Scope, headers: dict[str, list[str]]) -> None:
        host = _single(headers, "host")
        if self._rules.is_loopback and not _names_loopback(host):
            raise Refused(403, "the Host is not one of this machine's loopback")
        origin = _single(headers, "origin")
        if origin and origin.lower() not in (f"http://{host}".lower(), f"https://{host}".lower()):
            raise Refused(403, "pages of another origin are not answered")
        changes = scope["type"] == "websocket" or scope.get("method") in _CHANGING
        if changes and _single(headers, "sec-fetch-site") not in ("", "same-origin", "none"):
            raise Refused(403, "pages of another origin change nothing here")
        if self._rules.token and not self._is_open(scope["path"]):
            given = _token(scope, headers)
            if not hmac.compare_digest(given.encode(), self._rules.token.encode()):
                raise Refused(401, "the token is missing or wrong")
        if scope.get("method") in _CHANGING and _has_body(headers):
            kind = _single(headers, "content-type").partition(";")[0].strip().lower()
            if kind != "application/json":
                raise Refused(415, "the body must be application/json")


def _headers(scope: Scope) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name, value in scope["headers"]:
        found.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1").strip())
    return found


def _single(headers: dict[str, list[str]], name: str) -> str:
    values = headers.get(name, [])
    if len(values) > 1:
        raise Refused(400, f"the header {name} stands twice")
    return values[0] if values else ""


def _names_loopback(host: str) -> bool:
    name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
    return name.lower() == "localhost" or is_loopback(name.strip("[]"))


def _token(scope: Scope, headers: dict[str, list[str]]) -> str:
    if scope["type"] == "websocket":
        for protocol in scope.get("subprotocols", ()):
            if protocol.startswith(BEARER_PROTOCOL):
                return str(protocol.removeprefix(BEARER_PROTOCOL))
    scheme, _, token = _single(headers, "authorization").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""


def _has_body(headers: dict[str, list[str]]) -> bool:
    return "transfer-encoding" in headers or _single(headers, "content-length") not in ("", "0")


def _bounded(receive: Receive, headers: dict[str, list[str]]) -> Receive:
    """Limit what is received to `BODY_LIMIT` bytes, announced or not."""
    announced = _single(headers, "content-length")
    if announced and (not announced.isdecimal() or int(announced) > BODY_LIMIT):
        raise Refused(413, f"the body exceeds {BODY_LIMIT} bytes")
    taken = 0

    async def take() -> Message:
        nonlocal taken
        message = await receive()
        taken += len(message.get("body", b""))
        if taken > BODY_LIMIT:
            raise Refused(413, f"the body exceeds {BODY_LIMIT} bytes")
        return message

    return take


async def _refuse(error: Refused, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": error.detail})
        return
    headers = {"WWW-Authenticate": "Bearer"} if error.status_code == 401 else None
    await JSONResponse({"error": error.detail}, error.status_code, headers)(scope, receive, send)
