"""How a resource of the API is declared, once; the routes and the OpenAPI document are both made of that.

Knows declarations, JSON and HTTP; knows no simulation.

1. A resource is a function with `Operation` around it: method, path, what is asked, what is answered.
2. Whatever goes wrong is answered as `Failure`, a sentence; a wrong body is told with the key that is wrong.
"""

import json
import logging
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any, Final

from pydantic import BaseModel, ValidationError
from pydantic.json_schema import models_json_schema
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from ...errors import ModbusError
from .messages import Answer, Asked, Failure

_log = logging.getLogger("busway.apps.web")

OPENAPI_VERSION: Final = "3.1.0"
_SCHEMAS: Final = "#/components/schemas/{model}"
_JSON: Final = "application/json"
_MOST_FAULTS: Final = 5
"""Of a body that are told at once."""


class Problem(Exception):
    """It cannot be done: a status and a sentence."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


@dataclass(frozen=True, slots=True)
class OperationCall:
    """A request to a resource.

    Attributes:
        path: the variable parts of its path.
        query, body: as the operation declares them; None where it declares none.
        peer: who asks.
    """

    path: dict[str, str]
    query: Any  # an instance of what the operation declares
    body: Any
    peer: str


@dataclass(frozen=True, slots=True)
class Operation:
    """A resource.

    Attributes:
        method, path: ``GET``, ``/api/units/{unit}``.
        name: for programs that are generated, ``list_units``.
        summary: one sentence.
        answer: what it gives.
        handle: does it.
        body, query: what is asked.
        status: of the answer when all is well.
        rest: the variable part of the path that may hold slashes.
        failures: what else may be answered, with the reason.
    """

    method: str
    path: str
    name: str
    summary: str
    answer: type[Answer]
    handle: Callable[[OperationCall], Awaitable[Answer]]
    body: type[Asked] | None = None
    query: type[Asked] | None = None
    status: HTTPStatus = HTTPStatus.OK
    rest: str = ""
    failures: dict[HTTPStatus, str] = field(default_factory=dict)

    @property
    def variables(self) -> list[str]:
        """The variable parts of the path."""
        return [part[1:-1] for part in self.path.split("/") if part.startswith("{")]

    def route(self) -> Route:
        """The same for starlette."""
        path = self.path.replace(f"{{{self.rest}}}", f"{{{self.rest}:path}}") if self.rest else self.path
        return Route(path, self._answer, methods=[self.method], name=self.name)

    async def _answer(self, request: Request) -> Response:
        try:
            call = OperationCall(
                {name: str(value) for name, value in request.path_params.items()},
                _checked(self.query, dict(request.query_params)),
                None if self.body is None else _checked(self.body, _parsed(await request.body())),
                f"{request.client.host}:{request.client.port}" if request.client else "",
            )
            answer = await self.handle(call)
        except Problem as error:
            return failed(error.status, str(error))
        except ModbusError as error:
            key = getattr(error, "key", None)
            return failed(HTTPStatus.UNPROCESSABLE_ENTITY, f"{key}: {error.message}" if key else error.message)
        return Response(answer.model_dump_json(), self.status, media_type=_JSON)


def failed(status: int, sentence: str) -> Response:
    """A `Failure`. What a client wrote may stand in it, and may be no text: half of a surrogate pair."""
    sentence = sentence.encode("utf-8", "backslashreplace").decode()
    return Response(Failure(error=sentence).model_dump_json(), status, media_type=_JSON)


def _parsed(body: bytes) -> Any:
    try:
        return json.loads(body)
    except (ValueError, RecursionError) as error:
        raise Problem(HTTPStatus.BAD_REQUEST, "the body is no JSON") from error


def _checked(kind: type[Asked] | None, given: Any) -> Asked | None:
    if kind is None:
        return None
    try:
        return kind.model_validate(given)
    except ValidationError as error:
        found = error.errors(include_url=False, include_context=False, include_input=False)
        faults = [f"{_place(fault['loc'])}: {fault['msg'][:1].lower()}{fault['msg'][1:]}" for fault in found]
        more = f"; and {len(faults) - _MOST_FAULTS} more" if len(faults) > _MOST_FAULTS else ""
        raise Problem(HTTPStatus.UNPROCESSABLE_ENTITY, "; ".join(faults[:_MOST_FAULTS]) + more) from error


def _place(path: tuple[int | str, ...]) -> str:
    return ".".join(str(part) for part in path) or "the body"


# The document.


def openapi(operations: Sequence[Operation], *, title: str, version: str, description: str = "") -> dict[str, Any]:
    """The OpenAPI document of these operations."""
    models = _models(operations)
    _, schemas = models_json_schema([(model, _mode(model)) for model in models], ref_template=_SCHEMAS)
    paths: dict[str, dict[str, Any]] = {}
    for one in operations:
        paths.setdefault(one.path, {})[one.method.lower()] = _described(one)
    return {
        "openapi": OPENAPI_VERSION,
        "info": {"title": title, "version": version, "description": description},
        "paths": paths,
        "components": {
            "schemas": schemas.get("$defs", {}),
            "securitySchemes": {
                "token": {"type": "http", "scheme": "bearer", "description": "Needed where one was given, or printed."}
            },
        },
        "security": [{"token": []}, {}],
    }


def _models(operations: Sequence[Operation]) -> list[type[BaseModel]]:
    found: dict[type[BaseModel], None] = {Failure: None}
    for one in operations:
        found[one.answer] = None
        if one.body is not None:
            found[one.body] = None
    return list(found)


def _mode(model: type[BaseModel]) -> Any:  # a Literal of pydantic
    return "validation" if issubclass(model, Asked) else "serialization"


def _described(operation: Operation) -> dict[str, Any]:
    failures = {HTTPStatus.UNAUTHORIZED: "The token is missing or wrong.", **operation.failures}
    if operation.body is not None or operation.query is not None:
        failures.setdefault(HTTPStatus.UNPROCESSABLE_ENTITY, "What is asked can not be.")
    described: dict[str, Any] = {
        "operationId": operation.name,
        "summary": operation.summary,
        "responses": {
            str(int(operation.status)): {
                "description": _first_line(operation.answer),
                "content": _content(operation.answer),
            },
            **{
                str(int(status)): {"description": sentence, "content": _content(Failure)}
                for status, sentence in failures.items()
            },
        },
    }
    parameters = [
        {"name": name, "in": "path", "required": True, "schema": {"type": "string"}} for name in operation.variables
    ]
    parameters += _query_parameters(operation.query)
    if parameters:
        described["parameters"] = parameters
    if operation.body is not None:
        described["requestBody"] = {"required": True, "content": _content(operation.body)}
    return described


def _query_parameters(query: type[Asked] | None) -> list[dict[str, Any]]:
    if query is None:
        return []
    schema = query.model_json_schema(ref_template=_SCHEMAS)
    parameters = []
    for name, of_one in schema["properties"].items():
        parameter = {"name": name, "in": "query", "required": name in schema.get("required", ()), "schema": of_one}
        if "description" in of_one:
            parameter["description"] = of_one["description"]
        parameters.append(parameter)
    return parameters


def _content(model: type[BaseModel]) -> dict[str, Any]:
    return {_JSON: {"schema": {"$ref": _SCHEMAS.format(model=model.__name__)}}}


def _first_line(model: type[BaseModel]) -> str:
    return (model.__doc__ or "").strip().partition("\n")[0]
