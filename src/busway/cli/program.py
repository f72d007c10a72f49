"""The program ``busway``: loads the requested command, runs it, and ends with its exit code.

Knows how commands are found and how they end; knows nothing of what they do.

1. Only the module of the command that runs is imported, so that the program starts quickly.
2. An error is one sentence on stderr that names what is wrong. There is no traceback for anything that a user, a device
   or a network did. A defect of busway is one sentence, too; BUSWAY_TRACEBACK=1 shows where it is.
3. Every argument reaches its command as text. Commands convert texts to values themselves, so that an error can say in
   the words of the protocol what is wrong.
"""

import errno
import logging
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from ..errors import ModbusError
from ..extras import missing_extra
from ..values.printable import printable
from ..values.similar_names import similar_name
from .arguments import BEHIND_DASHES
from .exits import ExitCode, exit_code_of
from .streams import OutputLostError, ReaderGoneError, discard, guarded_streams

COMMANDS = {
    "read": "Read values from a device.",
    "write": "Write values to a device.",
    "identify": "Ask a device what it is.",
    "scan": "Find the units that answer on a line or behind an address.",
    "check": "Check a device against the specification.",
    "counters": "Read the communication counters of a device.",
    "serve": "Serve one or several devices over Modbus.",
    "simulate": "Serve simulated devices that a file describes.",
    "gateway": "Forward client requests to serial lines or other servers.",
    "collect": "Poll devices and store their values.",
    "fleet": "Share the links of a plant among several collectors.",
    "query": "Show what a store of the collector holds.",
    "store": "Check, back up or restore a store of the collector.",
    "status": "Show the status of servers and gateways, name pages of collectors.",
    "sniff": "Listen to a line, never send.",
    "decode": "Explain frames, field by field.",
    "replay": "Show what was said in a capture file, and what was wrong.",
    "points": "Convert device descriptions of other programs.",
    "config": "Check and explain configuration files.",
    "policy": "Say what a policy permits.",
    "certs": "Make test certificates, or show what certificates say.",
    "demo": "Run a small plant on a line, and poll it through a gateway.",
}
"""The commands with their help texts, in the order of the help. ``busway.cli.<name>`` holds the function ``<name>``."""

_OUTPUT_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EBADF)
_SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 100}


class Verbatim:
    """Type for typer that passes the text of an argument to the command unchanged.

    With its own type for texts typer would import pydantic, which takes 0.1 s.
    """

    @staticmethod
    def coerce(value: Any, param: Any, ctx: Any) -> Any:
        """Return the value unchanged; for a missing argument or option that takes several values, an empty tuple."""
        if value is None and (param.multiple or param.nargs == -1):
            return ()
        return value


class Command(TyperCommand):
    """A command of ``busway`` for typer; it gets its arguments as unchanged texts, and has a compact help."""

    def get_params(self, ctx: Any) -> list[Any]:
        return _verbatim(super().get_params(ctx))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        BEHIND_DASHES[:] = args[args.index("--") + 1 :] if "--" in args else ()
        return super().parse_args(ctx, args)

    def get_help_option_names(self, ctx: Any) -> list[str]:
        return sorted(super().get_help_option_names(ctx))[::-1]  # the parser's come from a set, in any order

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        return ["[OPTIONS]", *(param.metavar or param.name.upper() for param in _arguments(self))]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        # The texts say what an argument is; typer would add that each of them is a str.
        options = [param for param in self.get_params(ctx) if param.param_type_name == "option"]
        for title, rows in (
            ("Arguments", [(param.metavar or param.name.upper(), param.help or "") for param in _arguments(self)]),
            ("Options", [_option_row(param) for param in options]),
        ):
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


class Program(TyperGroup):
    """The group of all commands of ``busway``; the module of a command is imported only if the command is used."""

    def get_params(self, ctx: Any) -> list[Any]:
        return _verbatim(super().get_params(ctx))

    def get_help_option_names(self, ctx: Any) -> list[str]:
        return sorted(super().get_help_option_names(ctx))[::-1]

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in COMMANDS:
            return None
        return load(cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] not in COMMANDS and not ctx.resilient_parsing:
            similar = similar_name(args[0], COMMANDS)
            hint = f", but {', '.join(COMMANDS)}" if similar is None else f"; is it {similar}?"
            ctx.fail(f"there is no command {args[0]!r}{hint}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        # Here and not by the commands' own help: listing them would import them all.
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:  # typer would end with code 1
            raise ReaderGoneError from error

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> NoReturn:
        given = sys.argv[1:] if args is None else list(args)
        logging.raiseExceptions = False  # a log that cannot be written is lost without a traceback
        with guarded_streams():
            code = self._run(given or ["--help"], prog_name or "busway", complete_var, extra)
        sys.exit(int(code))

    def _run(self, given: list[str], name: str, complete_var: str | None, extra: dict[str, Any]) -> int:
        """Run a command, print its error as one sentence if it fails, and return the exit code.

        Args:
            given: words of the command line: options, the command and its arguments.
            name: name of the program, for the help.
            complete_var, extra: arguments that typer passes on.
        """
        code: int
        try:
            result = super().main(given, name, complete_var, standalone_mode=False, **extra)
            code = result if isinstance(result, int) else ExitCode.DONE
            sys.stdout.flush()
        except ModbusError as error:
            # What is wrong in a file begins with file and line, as editors expect it.
            # How a unit is named in Python is no help here.
            sentence = str(error).replace("link.unit(1)", "--unit 1")
            code = _fail(sentence, exit_code_of(error), prefix="" if getattr(error, "file", None) else "busway: ")
        except KeyboardInterrupt:
            code = ExitCode.INTERRUPTED
        except (BrokenPipeError, ReaderGoneError):
            discard(sys.stdout)  # who read the output has what he wanted
            code = ExitCode.DONE
        except OutputLostError as error:
            code = _fail(_lost_sentence(str(error)), ExitCode.OUTPUT_LOST)
        except Exception as error:
            code = _fail_unexpectedly(error)
        return code


def _verbatim(params: list[Any]) -> list[Any]:
    """Set the type `Verbatim` for all these parameters, so that commands get unchanged texts; return the parameters."""
    for param in params:
        param._runtime_param = Verbatim
    return params


def _arguments(command: Any) -> list[Any]:
    return [param for param in command.params if param.param_type_name == "argument"]


def _option_row(param: Any) -> tuple[str, str]:
    names = ", ".join([*param.opts, *param.secondary_opts])
    return f"{names} {param.metavar}" if param.metavar else names, param.help or ""


def load(name: str) -> Any:
    """Import the module of a command, and return the command in the form that typer's group needs."""
    module = import_module(f".{name}", __package__)
    single = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    settings = {**_SETTINGS, **getattr(module, "SETTINGS", {})}
    single.command(name, cls=Command, epilog=module.EXAMPLES, context_settings=settings)(getattr(module, name))
    return get_command(single)


def _fail(sentence: str, code: ExitCode, *, prefix: str = "busway: ") -> ExitCode:
    # A sentence for each problem of a file, each on a line; nothing in them is a control character of others.
    lines = [printable(line) for line in sentence.split("\n")]
    print(prefix + "\n".join(lines), file=sys.stderr, flush=True)
    return code


def _fail_unexpectedly(error: Exception) -> ExitCode:
    """Print an error that is no `ModbusError` as one sentence on stderr, and return the exit code.

    It is wrong usage, a missing package, a closed stream, or else a defect of busway. With BUSWAY_TRACEBACK a defect is
    raised again instead.
    """
    if hasattr(error, "format_message"):  # the parser's errors: of click, or of typer's copy of it
        return _fail(_usage_sentence(error), ExitCode.WRONG_USE)
    if isinstance(error, ImportError) and (missing := missing_extra(error)) is not None:
        return _fail(str(missing), ExitCode.WRONG_USE)
    if isinstance(error, OSError) and error.errno in _OUTPUT_ERRORS:  # help is printed past the guard
        discard(sys.stdout)
        return _fail(_lost_sentence(error.strerror or str(error)), ExitCode.OUTPUT_LOST)
    if os.environ.get("BUSWAY_TRACEBACK"):
        raise error
    what = f"{type(error).__name__}: {error}".rstrip(": ")
    return _fail(
        f"this is a defect of busway: {what}; please report it with what BUSWAY_TRACEBACK=1 shows", ExitCode.DEFECT
    )


def _lost_sentence(reason: str) -> str:
    return f"the output cannot be written: {reason[:1].lower()}{reason[1:]}"


def _usage_sentence(error: Any) -> str:
    """Return the parser's error about wrong usage as one sentence, with the name of the command in front if known."""
    context = getattr(error, "ctx", None)
    command = context.info_name if context is not None and context.parent is not None else ""
    words = " ".join(error.format_message().split())
    sentence = words[:1].lower() + words[1:].removesuffix(".")
    return f"{command}: {sentence}" if command else sentence


app: typer.Typer = typer.Typer(
    cls=Program,
    name="busway",
    help="Modbus: client, server, gateway, simulator, collector and fleet.",
    epilog="`busway COMMAND --help` shows examples.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings=_SETTINGS,
)


def _show_version(value: bool) -> None:
    if value:
        from ..version import __version__

        print(f"busway {__version__}")
        raise typer.Exit


@app.callback()
def _program(
    version: bool = typer.Option(False, "--version", help="Print the version.", is_eager=True, callback=_show_version),
) -> None:
    pass
