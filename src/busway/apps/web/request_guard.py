"""Access control of a web page: checks host, origin, caller and size of a request before the application gets it.

Knows headers, roles and sizes; knows no resource. The check wraps the whole application, HTTP and WebSocket.

1. On loopback no token is needed, but the ``Host`` must be a loopback name: a foreign name that resolves to 127.0.0.1
   (DNS rebinding) is refused.
2. Requests from pages of another origin are refused, by ``Origin`` and by ``Sec-Fetch-Site``. The body of a request
   that changes something must be JSON or TOML, which such a page cannot send before this server has allowed it (CORS).
3. On other addresses each request to the API carries a token, in ``Authorization: Bearer …``. A browser cannot set this
   header for a WebSocket, so a WebSocket carries the token as its subprotocol ``bearer.…``. A token is never part of a
   URL, because URLs end up in logs. The files of the page hold no secret and need no token.
4. Tokens are kept as digests. The digest of a request's token is compared with all of them, in constant time. Tokens
   are never logged.
5. A caller has a role: the role of the token; without a token, the role of the subject of the TLS client certificate;
   without either, the role for such callers. Where the page has tokens, a request with a wrong one is refused,
   whatever its certificate.
6. A request that changes something needs at least the role `Role.OPERATE`, also where a route forgets to say so; routes
   that need more say it with `require`.
7. A WebSocket outlives this check. The code that serves it calls `current_caller` before it sends, and closes the
   WebSocket once the caller is refused or has another role.
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

from ...log_limiter import LogLimiter, suppressed_note
from ..control.addresses import is_loopback

AsgiScope = MutableMapping[str, Any]  # Any: as ASGI has them
AsgiMessage = MutableMapping[str, Any]
AsgiReceive = Callable[[], Awaitable[AsgiMessage]]
AsgiSend = Callable[[AsgiMessage], Awaitable[None]]
AsgiApplication = Callable[[AsgiScope, AsgiReceive, AsgiSend], Awaitable[None]]

BODY_LIMIT: Final = 4 * 1024 * 1024
"""Largest number of bytes in the body of a request: room for a hundred thousand values."""
BEARER_PROTOCOL: Final = "bearer."
POLICY_VIOLATION: Final = 1008
"""Close code of a WebSocket that is refused (RFC 6455 §7.4.1)."""
CHANGING: Final = frozenset({"POST", "PUT", "PATCH", "DELETE"})
"""The HTTP methods of requests that change something."""
CERTIFICATE_SUBJECT: Final = "certificate_subject"
"""Key in the ``state`` of an ASGI scope: its value is the subject of the client's verified certificate (RFC 4514)."""
_BODY_KINDS: Final = ("application/json", "application/toml")
"""Media types that a body may have. A page of another origin can send neither unless this server has allowed it."""
_CALLER: Final = "busway.caller"
_FIND_CALLER: Final = "busway.find_caller"
_log = logging.getLogger("busway.apps.web")


class Role(IntEnum):
    """The role of a caller of a web page, which says what the caller may do; each role includes the roles before it."""

    VIEW = 1
    """See values, history and states."""
    OPERATE = 2
    """Write values, acknowledge alarms, begin and end maintenance."""
    CONFIGURE = 3
    """Replace the configuration."""

    @property
    def label(self) -> str:
        """The word for the role in files, messages and sentences, such as ``operate``."""
        return self.name.lower()


ROLES: Final = MappingProxyType({role.label: role for role in Role})
"""Roles by their labels, such as ``operate``."""


@dataclass(frozen=True, slots=True)
class Caller:
    """The sender of a request to a web page: name and role.

    Attributes:
        name: name of the token, subject of the certificate, or ``loopback`` for a caller with neither; it is recorded
            with each change.
        role: what the caller may do.
    """

    name: str
    role: Role


@dataclass(frozen=True, slots=True)
class AccessToken:
    """A token that gives a caller access to a web page; only its digest is kept.

    Attributes:
        caller: name and role of callers that send this token.
        digest: SHA-256 of the token, 32 bytes.
    """

    caller: Caller
    digest: bytes = field(repr=False)

    @classmethod
    def of(cls, token: str, name: str, role: Role) -> "AccessToken":
        """Return the access token with this plain text, for callers with this name and role."""
        return cls(Caller(name, role), _digest(token))


@dataclass(frozen=True, slots=True)
class PageAccessRules:
    """Which callers and hosts may use a web page on one address.

    Attributes:
        tokens: called for each check; returns the tokens that are valid now, possibly none. None: the page has no
            tokens, and a token in a request is ignored.
        subjects: role by the subject of a client certificate, in the form of RFC 4514: ``CN=anna,O=plant``.
        without_token: role of callers that have neither a token nor a certificate of ``subjects``; None: they are
            refused.
        is_loopback: whether only this host can reach the page; then the header ``Host`` must be a loopback name.
    """

    tokens: "Callable[[], Sequence[AccessToken]] | None" = None
    subjects: Mapping[str, Role] = field(default_factory=dict)
    without_token: Role | None = None
    is_loopback: bool = True


class Refused(HTTPException):
    """Error: a request is refused, with an HTTP status and a sentence for the response.

    A WebSocket is closed with code 1008 instead.
    """


@dataclass(frozen=True, slots=True)
class RequiredRole:
    """FastAPI dependency that refuses callers whose role is too low, and passes the caller to the route.

    Attributes:
        role: the lowest role that may use the route.
    """

    role: Role

    async def __call__(self, connection: HTTPConnection) -> Caller:
        """Return the caller of a request. Raises `Refused` (403) if its role is too low, (401) if it is unknown."""
        return _permitted(caller_of(connection.scope), self.role)


@functools.cache
def require(role: Role) -> RequiredRole:
    """Return the FastAPI dependency for a route that needs at least this role::

    async def confirm(key: str, caller: Annotated[Caller, Depends(require(Role.OPERATE))]) -> Answer: ...
    """
    return RequiredRole(role)


def caller_of(scope: AsgiScope) -> Caller:
    """Return the caller of a request that `PageAccess` has accepted. Raises `Refused` (401) for a request without one.

    Requests for the files of the page have no caller.
    """
    found = scope.get(_CALLER)
    if not isinstance(found, Caller):
        raise Refused(401, "the caller is not known")
    return found


def current_caller(scope: AsgiScope) -> Caller | None:
    """Return the caller of a request accepted earlier, by the tokens valid now; None if it would be refused now.

    ``scope`` is the ASGI scope of the request; the caller may have another role than before.
    """
    found: Caller | None = scope[_FIND_CALLER]()
    return found


def _permitted(caller: Caller, least: Role) -> Caller:
    if caller.role >= least:
        return caller
    raise Refused(403, f"this needs the role {least.label}, and {caller.name} may only {caller.role.label}")


class PageAccess:
    """ASGI middleware that refuses requests which break the access rules.

    Args:
        inner: the ASGI application that gets the accepted requests.
        rules: who may use the page on this address.
        is_open: called with the path of a request; returns True if no caller need be known, as for the page's files.
    """

    def __init__(self, inner: AsgiApplication, rules: PageAccessRules, is_open: Callable[[str], bool]) -> None:
        self._inner = inner
        self._rules = rules
        self._is_open = is_open
        self._wrong_tokens = LogLimiter()

    async def __call__(self, scope: AsgiScope, receive: AsgiReceive, send: AsgiSend) -> None:
        """Check one HTTP request or WebSocket; pass it on to the application, or answer that it is refused."""
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

    def _check(self, scope: AsgiScope, headers: dict[str, list[str]]) -> None:
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

    def _caller(self, scope: AsgiScope, headers: dict[str, list[str]]) -> Caller:
        """Return the caller of a request. Raises `Refused` (401) if it needs a token, or if its token is wrong.

        Stores in ``scope`` the function with which `current_caller` finds the caller again later.
        """
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
        repeated = self._wrong_tokens.admit(host, time.monotonic())
        if repeated is not None:
            _log.warning("a wrong token was shown to the page from %s%s", host, suppressed_note(repeated))
        raise Refused(401, "the token is wrong")

    def _find(self, digest: bytes | None, subject: str) -> Caller | None:
        """Return the caller by its token, or if it has none by its certificate, or else the caller for such requests.

        Returns None if the caller is refused: the token is wrong, or callers without token and certificate are refused.
        On a page without tokens a token does not count.

        Args:
            digest: digest of the token in the request; None without a token.
            subject: subject of the client's certificate; empty without one.
        """
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


def _headers(scope: AsgiScope) -> dict[str, list[str]]:
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


def _token(scope: AsgiScope, headers: dict[str, list[str]]) -> str | None:
    """Return the token in a request (subprotocol of a WebSocket, or ``Authorization``); None if it has neither.

    Returns an empty text, which is a wrong token, if ``Authorization`` has another scheme than ``Bearer``.
    """
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


def _bounded(receive: AsgiReceive, headers: dict[str, list[str]]) -> AsgiReceive:
    """Return a ``receive`` that raises `Refused` (413) once a body exceeds `BODY_LIMIT` bytes.

    Raises `Refused` (413) at once if ``Content-Length`` announces more or is no number.
    """
    announced = _single(headers, "content-length")
    if announced and (not announced.isdecimal() or int(announced) > BODY_LIMIT):
        raise Refused(413, f"the body exceeds {BODY_LIMIT} bytes")
    taken = 0

    async def take() -> AsgiMessage:
        nonlocal taken
        message = await receive()
        taken += len(message.get("body", b""))
        if taken > BODY_LIMIT:
            raise Refused(413, f"the body exceeds {BODY_LIMIT} bytes")
        return message

    return take


async def _refuse(error: Refused, scope: AsgiScope, receive: AsgiReceive, send: AsgiSend) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": error.detail})
        return
    headers = {"WWW-Authenticate": "Bearer"} if error.status_code == 401 else None
    await JSONResponse({"error": error.detail}, error.status_code, headers)(scope, receive, send)
