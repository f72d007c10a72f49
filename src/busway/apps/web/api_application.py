"""The FastAPI application of a page's API: how errors are answered, and its OpenAPI document.

Knows FastAPI, JSON and HTTP; knows no simulation and no collector. FastAPI derives the routes, the checks of requests
and the document from the signatures of the functions that are added to the application.

1. Every error is answered with a `Failure`, which holds a sentence. For an invalid body the sentence names the wrong
   keys.
"""

from collections.abc import Callable, Coroutine, Mapping
from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from ...errors import ModbusError
from ...version import __version__
from .messages import Failure

_MOST_PROBLEMS: Final = 5
"""Largest number of problems of one body that the response names; the others are counted."""
_NO_JSON: Final = "the body is no JSON"
_RESPONSES: Final[dict[int | str, dict[str, Any]]] = {
    401: {"model": Failure, "description": "The token is missing or wrong."},
    422: {"model": Failure, "description": "The request does not fit."},
}
_TOKEN: Final = {"type": "http", "scheme": "bearer", "description": "Needed where one was given, or printed."}

ErrorHandler = Callable[[Request, Any], Coroutine[Any, Any, Response]]  # Any: the exception that it handles


def new_application(title: str, description: str, handlers: Mapping[Any, ErrorHandler]) -> FastAPI:
    """Return a FastAPI application without routes that answers invalid requests and `ModbusError` with a `Failure`.

    Args:
        title: title of the OpenAPI document.
        description: description in the OpenAPI document.
        handlers: functions that answer further exceptions, by class of the exception.
    """
    return FastAPI(
        title=title,
        version=__version__,
        description=description,
        docs_url=None,
        redoc_url=None,
        generate_unique_id_function=lambda route: str(route.name),
        responses=_RESPONSES,
        exception_handlers={
            HTTPException: _http_failed,
            RequestValidationError: _not_fitting,
            ModbusError: _not_possible,
            **handlers,
        },
    )


def secure_document(application: FastAPI) -> None:
    """Add to the OpenAPI document that a token may be needed: FastAPI does not see `request_guard`, which checks it.

    Call this after the last route was added: it makes the document, which then stays the same.
    """
    document = application.openapi()
    document["components"]["securitySchemes"] = {"token": _TOKEN}
    document["security"] = [{"token": []}, {}]


def failed(status: int, sentence: str) -> Response:
    """Return the response for a failed request: a `Failure` as JSON.

    Args:
        status: the HTTP status.
        sentence: the error. Lone surrogates from a client's text, which UTF-8 cannot encode, are escaped.
    """
    sentence = sentence.encode("utf-8", "backslashreplace").decode()
    return Response(Failure(error=sentence).model_dump_json(), status, media_type="application/json")


async def _http_failed(request: Request, error: HTTPException) -> Response:
    if error.__cause__ is not None and error.status_code == HTTPStatus.BAD_REQUEST:
        return failed(error.status_code, _NO_JSON)  # of FastAPI, which could not read it
    if error.detail != HTTPStatus(error.status_code).phrase:
        return failed(error.status_code, error.detail)
    if error.status_code == HTTPStatus.NOT_FOUND:
        return failed(error.status_code, "there is no such resource; /openapi.json lists them")
    return failed(error.status_code, f"{request.method} is not possible here: {error.detail}")


async def _not_fitting(request: Request, error: RequestValidationError) -> Response:
    problems = error.errors()
    if any(one["type"] == "json_invalid" for one in problems):
        return failed(HTTPStatus.BAD_REQUEST, _NO_JSON)
    named = [f"{_place(one['loc'])}: {one['msg'][:1].lower()}{one['msg'][1:]}" for one in problems]
    more = f"; and {len(named) - _MOST_PROBLEMS} more" if len(named) > _MOST_PROBLEMS else ""
    return failed(HTTPStatus.UNPROCESSABLE_ENTITY, "; ".join(named[:_MOST_PROBLEMS]) + more)


async def _not_possible(request: Request, error: ModbusError) -> Response:
    key = getattr(error, "key", None)
    return failed(HTTPStatus.UNPROCESSABLE_ENTITY, f"{key}: {error.message}" if key else error.message)


def _place(path: tuple[int | str, ...]) -> str:
    """Return the key of a validation error of FastAPI, such as ``schedule.after``; ``the body`` if it has no key.

    Args:
        path: the location in the error; its first item (``body``, ``query``, …) is left out.
    """
    return ".".join(str(part) for part in path[1:]) or "the body"
