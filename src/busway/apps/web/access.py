"""Access control of a web page: checks host, origin, caller and size of every request before the application.

Knows headers, roles and sizes; knows no resource. It wraps the whole application, HTTP and WebSocket.

1. On loopback no token is needed, but the ``Host`` must be a loopback name: a foreign name that resolves to 127.0.0.1
   (DNS rebinding) is refused.
2. Pages of another origin are refused, by ``Origin`` and by ``Sec-Fetch-Site``. Requests that change something must be
   JSON, which such a page cannot send without asking first.
3. Elsewhere each request to the API carries the token, in ``Authorization: Bearer …``; a WebSocket, for which a browser
   sets no such header, as its subprotocol ``bearer.…``. It is never part of a URL, which would end up in logs.
   The page itself holds no secret and needs no token.
4. Tokens are kept as digests, and compared in constant time with every one that there is. They are never logged.
5. A caller has a role: that of the token, or else that of the subject of the TLS client certificate, or else that of
   callers without either. A wrong token is refused, and never taken for none.
6. What changes something needs at least the role `Role.OPERATE`, also where a route forgets to say so; routes that need
   more say it with `require`.
7. A WebSocket outlives this check: what serves it asks `current_caller` before it sends, and closes it once the answer
   is another.
"""

import functools
import hashlib
import hmac
import logging
import time
from collections.abc import Awaitable, Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from types import MappingProxyType
from typing import Any, Final

from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse

from ...access.repeats import Repeats, so_often
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
CHANGING: Final = frozenset({"POST", "PUT", "PATCH", "DELETE"})
"""The methods of requests that change something."""
CERTIFICATE_SUBJECT: Final = "certificate_subject"
"""Key in the ``state`` of a connection: the subject of the client's certificate, which was verified (RFC 4514)."""
_BODY_KINDS: Final = ("application/json", "application/toml")
"""Types of bodies. A page of another origin can send neither without asking first."""
_CALLER: Final = "busway.caller"
_FIND_CALLER: Final = "busway.find_caller"
_log = logging.getLogger("busway.apps.web")


class Role(IntEnum):
    """Roles of callers of a web page; each role may do what those before it may."""

    VIEW = 1
    """See values, history and states."""
    OPERATE = 2
    """Write values, acknowledge alarms, begin and end maintenance."""
    CONFIGURE = 3
    """Replace the configuration."""

    @property
    def label(self) -> str:
        """The role as a word in files, messages and sentences, such as ``operate``."""
        return self.name.lower()


ROLES: Final = MappingProxyType({role.label: role for role in Role})
"""Roles by their words."""


@dataclass(frozen=True, slots=True)
class Caller:
    """The sender of a request to a web page: name and role.

    Attributes:
        name: name of the token, subject of the certificate, or ``loopback``; for records of what was changed.
        role: what the caller may do.
    """

    name: str
    role: Role


@dataclass(frozen=True, slots=True)
class AccessToken:
    """A token that gives a caller access to a web page; only its digest is kept.

    Attributes:
        caller: the caller that it identifies, with the role.
        digest: SHA-256 of the token.
    """

    caller: Caller
    digest: bytes = field(repr=False)

    @classmethod
    def of(cls, token: str, name: str, role: Role) -> "AccessToken":
        """Create an access token for a web page from its plain text."""
        return cls(Caller(name, role), _digest(token))


@dataclass(frozen=True, slots=True)
class PageAccessRules:
    """Which hosts, origins and callers may use a web page on one address.

    Attributes:
        tokens: gives all that are taken now, which may be none; None for a page that has no tokens: one that is shown
            there means nothing.
        subjects: role by the subject of a client certificate, as RFC 4514 writes it: ``CN=anna,O=plant``.
        without_token: role of callers that show neither; None where they are refused.
        is_loopback: whether it can be reached from this host alone.
    """

    tokens: "Callable[[], Sequence[AccessToken]] | None" = None
    subjects: Mapping[str, Role] = field(default_factory=dict)
    without_token: Role | None = None
    is_loopback: bool = True


class Refused(HTTPException):
    """Error that the page answers with an HTTP status and a sentence."""


@dataclass(frozen=True, slots=True)
class RequiredRole:
    """FastAPI dependency of a route: refuses callers with too low a role, and gives the caller to the route.

    Attributes:
        role: the least role.
    """

    role: Role

    async def __call__(self, connection: HTTPConnection) -> Caller:
        """Return the caller of a request if its role suffices. Raises `Refused`."""
        return _permitted(caller_of(connection.scope), self.role)


@functools.cache
def require(role: Role) -> RequiredRole:
    """Dependency of a FastAPI route that only callers of at least this role may use::

    async def confirm(key: str, caller: Annotated[Caller, Depends(require(Role.OPERATE))]) -> Answer: ...
    """
    return RequiredRole(role)


def caller_of(scope: Scope) -> Caller:
    """Return the caller of a request that `PageAccess` has accepted. Raises `Refused` for any other."""
    found = scope.get(_CALLER)
    if not isinstance(found, Caller):
        raise Refused(401, "the caller is not known")
    return found


def current_caller(scope: Scope) -> Caller | None:
    """Return the caller of an accepted request, by the tokens valid now; None if it would be refused now."""
    found: Caller | None = scope[_FIND_CALLER]()
    return found


def _permitted(caller: Caller, least: Role) -> Caller:
    if caller.role >= least:
        return caller
    raise Refused(403, f"this needs the role {least.label}, and {caller.name} may only {caller.role.label}")


class PageAccess:
    """ASGI middleware that refuses requests which break the access rules.

    Args:
        inner: the application.
        rules: rules of the listener.
        is_open: whether a path needs no token.
    """

    def __init__(self, inner: Application, rules: PageAccessRules, is_open: Callable[[str], bool]) -> None:
        self._inner = inner
        self._rules = rules
        self._is_open = is_open
        self._wrong_tokens = Repeats()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check one HTTP request or WebSocket, and pass it on to the application."""
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
        changes = scope["type"] == "websocket" or scope.get("method") in CHANGING
        if changes and _single(headers, "sec-fetch-site") not in ("", "same-origin", "none"):
            raise Refused(403, "pages of another origin change nothing here")
        if not self._is_open(scope["path"]):
            caller = self._caller(scope, headers)
            if scope.get("method") in CHANGING:
                _permitted(caller, Role.OPERATE)
            scope[_CALLER] = caller
        if scope.get("method") in CHANGING and _has_body(headers):
            kind = _single(headers, "content-type").partition(";")[0].strip().lower()
            if kind not in _BODY_KINDS:
                raise Refused(415, f"the body must be {' or '.join(_BODY_KINDS)}")

    def _caller(self, scope: Scope, headers: dict[str, list[str]]) -> Caller:
        """Return the caller of a request, and store how to find it again while the request lasts (rule 7)."""
        given = _token(scope, headers)
        digest = None if given is None or self._rules.tokens is None else _digest(given)
        subject = scope.get("state", {}).get(CERTIFICATE_SUBJECT, "")
        find = scope[_FIND_CALLER] = functools.partial(self._find, digest, subject)
        found = find()
        if found is not None:
            return found
        if digest is None:
            raise Refused(401, "a token is needed")
        host = (scope.get("client") or ("",))[0]
        repeated = self._wrong_tokens.again(host, time.monotonic())
        if repeated is not None:
            _log.warning("a wrong token was shown to the page from %s%s", host, so_often(repeated))
        raise Refused(401, "the token is wrong")

    def _find(self, digest: bytes | None, subject: str) -> Caller | None:
        """Return the caller by token, by certificate or by neither (rule 5); None if it is refused."""
        if digest is not None and self._rules.tokens is not None:
            found: Caller | None = None
            for token in self._rules.tokens():  # all of them: the time says nothing about which one it was
                if hmac.compare_digest(token.digest, digest):
                    found = token.caller
            return found
        role = self._rules.subjects.get(subject) if subject else None
        if role is not None:
            return Caller(subject, role)
        without = self._rules.without_token
        return None if without is None else Caller("loopback", without)


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).digest()


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


def _token(scope: Scope, headers: dict[str, list[str]]) -> str | None:
    """Return the access token in a request; None if there is none."""
    if scope["type"] == "websocket":
        for protocol in scope.get("subprotocols", ()):
            if protocol.startswith(BEARER_PROTOCOL):
                return str(protocol.removeprefix(BEARER_PROTOCOL))
    given = _single(headers, "authorization")
    if not given:
        return None
    scheme, _, token = given.partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""


def _has_body(headers: dict[str, list[str]]) -> bool:
    return "transfer-encoding" in headers or _single(headers, "content-length") not in ("", "0")


def _bounded(receive: Receive, headers: dict[str, list[str]]) -> Receive:
    """Limit the received body of a request to `BODY_LIMIT` bytes, announced or not."""
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
