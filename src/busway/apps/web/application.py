"""The one application of all pages: its shell, the modules that a program adds, its files, and the caller's role.

Knows HTML, files and FastAPI; knows no resource of a module, and no socket.

1. A page is the shell ``page/index.html`` with the modules of the program that serves it. A module has a name, the file
   ``page/NAME.html`` with its views, the script ``page/NAME.js``, and the routes of its API.
2. All pages have the same files, access rules and headers, and tell the caller its name and role.
3. The page consists of files of this package alone: its content security policy (CSP) allows no other files, and no
   script within HTML.
"""

import hashlib
import logging
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Annotated, Final, Protocol

from fastapi import Depends, FastAPI
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from .api_application import failed, new_application, secure_document
from .connections import Throttle
from .messages import CallerAnswer
from .request_guard import (
    AsgiApplication,
    AsgiMessage,
    AsgiReceive,
    AsgiScope,
    AsgiSend,
    Caller,
    PageAccess,
    PageAccessRules,
    Role,
    require,
)

_errors = logging.getLogger("busway.apps.web.errors")
"""Log of requests that failed with an unexpected error. Each message is logged at most once a minute, as a client can
repeat such a request without limit.
"""
_errors.addFilter(Throttle())

_KINDS: Final = {
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    "LICENSE": "text/plain; charset=utf-8",
}
"""Content types by the ends of file names; the HTML files are parts of the shell and not served by themselves."""
_PARTS: Final = ("controls", "views", "dialogs")
"""Parts of a module's HTML file, any of them or all. Each begins with ``<!-- NAME -->``, which the shell has too."""
_HEADERS: Final = (
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self';"
        b" base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
)


class PageModule(Protocol):
    """Interface of a part of a page: its views (``page/NAME.html``, ``page/NAME.js``), and the routes of its API."""

    @property
    def name(self) -> str:
        """The name of the module: NAME in the names of its files."""

    def add_to(self, application: FastAPI) -> None:
        """Add the routes of the module's API to a FastAPI application."""


@dataclass(frozen=True, slots=True)
class _File:
    """One static file of the web page: its bytes, content type and HTTP ``ETag``."""

    content: bytes
    kind: str
    tag: str

    @classmethod
    def of(cls, content: bytes, kind: str) -> "_File":
        """Return a file with these bytes and this content type; its ``ETag`` is computed from the bytes."""
        return cls(content, kind, f'"{hashlib.sha256(content).hexdigest()[:16]}"')


def page_resources(title: str, description: str, modules: Sequence[PageModule]) -> FastAPI:
    """Return the HTTP API of a page: the routes of its modules and ``/api/caller``, without files and access rules.

    Unexpected errors of the routes are logged and answered with status 500.

    Args:
        title: title of the OpenAPI document.
        description: description in the OpenAPI document.
        modules: the modules of the page.
    """
    application = new_application(title, description, {Exception: _failed})
    application.add_api_route("/api/caller", _get_caller, methods=["GET"], summary="The caller and its role")
    for module in modules:
        module.add_to(application)
    return application


async def _get_caller(caller: Annotated[Caller, Depends(require(Role.VIEW))]) -> CallerAnswer:
    """Return name and role of the caller."""
    return CallerAnswer(name=caller.name, role=caller.role.label)


def guarded(inner: FastAPI, names: Sequence[str], rules: PageAccessRules) -> AsgiApplication:
    """Return the ASGI application of a page: an API, the files of the page, access rules and common HTTP headers.

    Args:
        inner: application with all routes of the API; routes for the files are added to it, and its OpenAPI document is
            completed.
        names: the names of the page's modules, in the order of their views.
        rules: who may use the API; the files of the page need no token.
    """
    page = {"/": _File.of(_shell(names).encode(), "text/html; charset=utf-8"), **dict(_assets())}

    async def show_file(request: Request) -> Response:
        found = page[request.url.path]
        headers = {"ETag": found.tag, "Cache-Control": "no-cache"}
        if request.headers.get("if-none-match") == found.tag:
            return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
        return Response(found.content, media_type=found.kind, headers=headers)

    inner.routes.extend(Route(path, show_file) for path in page)
    secure_document(inner)
    return _with_headers(PageAccess(inner, rules, lambda path: path in page))


def _folder() -> Traversable:
    return files(__package__) / "page"


def _shell(names: Sequence[str]) -> str:
    """Return the HTML of a page: the shell with the views of its modules, in their order."""
    html = (_folder() / "index.html").read_text(encoding="utf-8").replace("<!-- modules -->", " ".join(names))
    modules = [_parts_of((_folder() / f"{name}.html").read_text(encoding="utf-8")) for name in names]
    for part in _PARTS:
        html = html.replace(f"<!-- {part} -->", "".join(each.get(part, "") for each in modules).strip("\n"))
    return html


def _parts_of(html: str) -> dict[str, str]:
    """Return the parts of a module's HTML file by name: ``controls``, ``views``, ``dialogs``, as far as it has them."""
    _, *found = re.split(f"<!-- ({'|'.join(_PARTS)}) -->", html)
    return dict(zip(found[::2], found[1::2], strict=True))


def _assets() -> Iterator[tuple[str, _File]]:
    """Yield URL path and file for each file that all pages have: styles, scripts and pictures."""
    for path, one in _below(_folder(), ""):
        kind = next((kind for end, kind in _KINDS.items() if one.name.endswith(end)), None)
        if kind is not None:
            yield path, _File.of(one.read_bytes(), kind)


def _below(folder: Traversable, path: str) -> Iterator[tuple[str, Traversable]]:
    for one in folder.iterdir():
        if one.is_dir():
            yield from _below(one, f"{path}/{one.name}")
        else:
            yield f"{path}/{one.name}", one


def _with_headers(inner: AsgiApplication) -> AsgiApplication:
    """Return an ASGI application that passes requests to ``inner`` and adds the page's common HTTP headers."""

    async def application(scope: AsgiScope, receive: AsgiReceive, send: AsgiSend) -> None:
        async def send_more(message: AsgiMessage) -> None:
            if message["type"] == "http.response.start":
                headers: list[tuple[bytes, bytes]] = [*message["headers"], *_HEADERS]
                if not any(name.lower() == b"cache-control" for name, _ in headers):
                    headers.append((b"cache-control", b"no-store"))
                message = {**message, "headers": headers}
            await send(message)

        await inner(scope, receive, send_more)

    return application


async def _failed(request: Request, error: Exception) -> Response:
    _errors.error("a request could not be answered", exc_info=error)
    return failed(HTTPStatus.INTERNAL_SERVER_ERROR, "it could not be answered; the log says why")
