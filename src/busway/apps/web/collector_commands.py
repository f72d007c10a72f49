"""HTTP API of the collector's page for commands (arm, confirm, write, list) and for the configuration file.

A command writes a value to a point. Knows a running collector and the roles of callers; judges no value.

1. `arm_command` sends nothing to a device. `confirm_command` sends the command once; confirming it again returns the
   first result.
2. The response has the result of a command, also if the command was refused. A request that cannot be a command at all
   is answered with 422, an unknown point or key with 404.
3. A new configuration is in force when the response comes, or it is refused as a whole, with all its errors. A request
   can name the revision that it was edited from; it is refused if another one is in force by now, so that no change
   of another person is lost.
"""

from typing import Annotated, Any, Final

from fastapi import Depends, FastAPI, Query
from fastapi import Path as InPath
from pydantic import Field
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from ...config.files.file_error import FileError
from ...errors import ConfigError, Overloaded
from ..collector.collector import Collector
from ..collector.commands.command import CommandResult, CommandValue, OldValue
from ..collector.commands.rights import WriterRights
from ..collector.commands.runner import NoSuchCommand, NoSuchPoint
from .messages import Answer, Asked, Failure, Plain, plain_value
from .request_guard import Caller, Role, require

MOST_LISTED: Final = 1000
_LONGEST_NAME: Final = 200

Operator = Annotated[Caller, Depends(require(Role.OPERATE))]
Configurer = Annotated[Caller, Depends(require(Role.CONFIGURE))]
ViewerCaller = Annotated[Caller, Depends(require(Role.VIEW))]

NameField = Annotated[str, Field(min_length=1, max_length=_LONGEST_NAME)]


class NewCommand(Asked):
    """Request to check a value for a point and keep the command until it is confirmed."""

    device: NameField
    point: NameField
    value: Plain = Field(description="In the unit of measure, or a name of a number; numbers are no texts.")


class DirectCommand(NewCommand):
    """Request to write a value to a point at once."""

    key: str | None = Field(None, max_length=100, description="Names the command for ever; none: a new one is made.")
    expires: float = Field(description="Until when it may be sent, seconds since 1970 UTC.")


class OldAnswer(Answer):
    """Response: the value that a point had before it was written."""

    value: Plain
    quality: str
    time: float = Field(description="Seconds since 1970 UTC.")


class ArmedAnswer(Answer):
    """Response: a command that was checked and waits to be confirmed."""

    key: str
    device: str
    point: str
    value: Plain
    old: OldAnswer | None
    expires: float = Field(description="Until when it may be confirmed, seconds since 1970 UTC.")
    confirm: str = Field(description="What to ask the person.")


class CommandAnswer(Answer):
    """Response: the result of a command that writes a point."""

    key: str
    at: float = Field(description="When it was taken, seconds since 1970 UTC.")
    by: str
    origin: str = Field(description="page, api, program, mqtt, nats, sparkplug or fleet")
    device: str
    point: str
    old: Plain
    value: Plain
    state: str = Field(description="open, done, failed, unknown, expired or refused")
    read_back: Plain
    reason: str | None


class CommandsAnswer(Answer):
    """Response: results of commands that write points, the newest first."""

    commands: list[CommandAnswer]


class ConfigurationAnswer(Answer):
    """Response: the text of the configuration in force, and its revision."""

    revision: str
    text: str = Field(description="The file, in TOML. Secrets are in other files.")


class ReplacedAnswer(Answer):
    """Response: the configuration was replaced; its new revision."""

    revision: str
    done: list[str] = Field(description="What changed, each a sentence.")


class ProblemAnswer(Answer):
    """Response: one error in a configuration, with its line."""

    file: str | None
    line: int | None
    key: str | None
    message: str


class ProblemsAnswer(Failure):
    """Response: all errors for which a configuration was refused."""

    problems: list[ProblemAnswer]


class CommandsApi:
    """Routes of the collector's page for commands, which write points, and for the configuration."""

    def __init__(self, collector: Collector) -> None:
        self._collector = collector

    def add_to(self, application: FastAPI) -> None:
        """Add the routes for commands and the configuration to a FastAPI application."""
        add = application.add_api_route
        missing: dict[int | str, dict[str, Any]] = {
            404: {"model": Failure, "description": "There is no such point or command."}
        }
        full: dict[int | str, dict[str, Any]] = {
            503: {"model": Failure, "description": "Too many wait to be confirmed."}
        }
        unread: dict[int | str, dict[str, Any]] = {
            503: {"model": Failure, "description": "The journal of commands cannot be read."}
        }
        add(
            "/api/commands/arm",
            self.arm_command,
            methods=["POST"],
            summary="Check a command; nothing is sent",
            responses={**missing, **full},
        )
        add(
            "/api/commands/{key}/confirm",
            self.confirm_command,
            methods=["POST"],
            summary="Send an armed command, once",
            responses={**missing, **unread},
        )
        add(
            "/api/commands",
            self.send_command,
            methods=["POST"],
            summary="Write a value to a point, at most once for each key",
            responses=missing,
        )
        add(
            "/api/commands",
            self.list_commands,
            methods=["GET"],
            summary="The last commands, the newest first",
            responses=unread,
        )
        add("/api/configuration", self.get_configuration, methods=["GET"], summary="The configuration that holds")
        add(
            "/api/configuration",
            self.replace_configuration,
            methods=["POST"],
            response_model=ReplacedAnswer,
            summary="Replace the configuration",
            responses={422: {"model": ProblemsAnswer, "description": "It is refused as a whole."}},
            openapi_extra={
                "requestBody": {"content": {"application/toml": {"schema": {"type": "string"}}}, "required": True}
            },
        )

    async def arm_command(self, asked: NewCommand, caller: Operator) -> ArmedAnswer:
        """Check a command against the writing rule of its point, and keep it for a minute. Sends nothing.

        The command must be confirmed within that time. 404: unknown point; 503: too many commands wait.
        """
        value = _given(asked.value)
        try:
            armed = self._collector.commands.arm(
                asked.device, asked.point, value, by=caller.name, origin="page", rights=WriterRights(caller.role.label)
            )
        except NoSuchPoint as error:
            raise HTTPException(404, error.message) from error
        except Overloaded as error:
            raise HTTPException(503, error.message) from error
        command = armed.command
        return ArmedAnswer(
            key=command.key,
            device=command.device,
            point=command.point,
            value=_plain(command.value),
            old=_old(armed.old),
            expires=command.expires,
            confirm=armed.sentence,
        )

    async def confirm_command(self, key: Annotated[str, InPath(max_length=100)], caller: Operator) -> CommandAnswer:
        """Send a checked command to its device, and return the result. A second time returns the same result.

        503: the journal, where the result of one that was sent before is, cannot be read.
        """
        try:
            rights = WriterRights(caller.role.label)
            return _answer(await self._collector.commands.confirm(key, by=caller.name, origin="page", rights=rights))
        except NoSuchCommand as error:
            raise HTTPException(404, error.message) from error
        except OSError as error:
            raise HTTPException(503, str(error)) from error

    async def send_command(self, asked: DirectCommand, caller: Operator) -> CommandAnswer:
        """Check a command, send it to its device, and return the result. A key that was used before sends nothing."""
        try:
            result = await self._collector.commands.write(
                asked.device,
                asked.point,
                _given(asked.value),
                by=caller.name,
                expires=asked.expires,
                key=asked.key,
                origin="api",
                rights=WriterRights(caller.role.label),
            )
        except NoSuchPoint as error:
            raise HTTPException(404, error.message) from error
        return _answer(result)

    async def list_commands(
        self, caller: ViewerCaller, limit: Annotated[int, Query(ge=1, le=MOST_LISTED)] = 100
    ) -> CommandsAnswer:
        """Return the results of the latest commands, the newest first. 503: their journal cannot be read."""
        try:
            newest = await self._collector.commands.newest(limit)
        except OSError as error:
            raise HTTPException(503, str(error)) from error
        return CommandsAnswer(commands=[_answer(each) for each in newest])

    async def get_configuration(self, caller: Configurer) -> ConfigurationAnswer:
        """Return the text of the configuration in force (TOML), and its revision."""
        return ConfigurationAnswer(revision=self._collector.revision, text=self._collector.configuration.text)

    async def replace_configuration(
        self,
        request: Request,
        caller: Configurer,
        revision: Annotated[
            str | None, Query(max_length=64, description="Of the text that it is a change of; none: any.")
        ] = None,
    ) -> Response | ReplacedAnswer:
        """Replace the configuration file by the body (TOML), and return its revision and what changed.

        Links that are the same in both configurations miss no polling round. An invalid configuration changes nothing,
        and is answered with 422 and all errors.
        """
        try:
            text = (await request.body()).decode("utf-8")
        except UnicodeDecodeError as error:
            raise HTTPException(422, f"the body is no UTF-8: byte {error.start}") from error
        try:
            done = await self._collector.replace_configuration(text, by=caller.name, revision=revision)
        except ConfigError as error:
            problems = error.problems if isinstance(error, FileError) else [error]
            answer = ProblemsAnswer(error=str(error), problems=[_problem(each) for each in problems])
            return JSONResponse(answer.model_dump(), 422)
        return ReplacedAnswer(revision=self._collector.revision, done=done)


def _given(value: Plain) -> CommandValue:
    if isinstance(value, list):
        items = [each for each in value if each is not None]
        if len(items) == len(value):
            return items
    elif value is not None:
        return value
    raise HTTPException(422, "value: null is no value to write")


def _answer(result: CommandResult) -> CommandAnswer:
    command = result.command
    return CommandAnswer(
        key=command.key,
        at=result.at,
        by=command.by,
        origin=command.origin,
        device=command.device,
        point=command.point,
        old=None if result.old is None else _plain(result.old.value),
        value=_plain(command.value),
        state=result.state.value,
        read_back=_plain(result.read_back),
        reason=result.reason or None,
    )


def _old(old: OldValue | None) -> OldAnswer | None:
    return None if old is None else OldAnswer(value=_plain(old.value), quality=old.quality, time=old.time)


def _plain(value: CommandValue | None) -> Plain:
    return plain_value(value)


def _problem(error: ConfigError) -> ProblemAnswer:
    return ProblemAnswer(file=error.file, line=error.line, key=error.key, message=error.message)
