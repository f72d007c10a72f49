"""The exit codes of all commands, and which error ends with which code.

====  =============================================================================================================
code  meaning
====  =============================================================================================================
0     done
1     ``check``: a must of the specification does not hold
2     wrong use: an invalid argument, option, file or URL; nothing was sent
3     no reply came, or the outcome of a write is not known
4     refused: by the device with an exception code, by a policy (``policy test``), as a plan (``collect plan``)
5     no connection, or it ended; a server that cannot listen
6     the reply, a frame given to ``decode``, or a store given to ``store check`` is broken; a device died at ``check``
7     written, but the device holds something else or could not be read back: ``write --verify``, ``fleet write``
8     the output cannot be written: a full disk, a stream that is closed
70    a defect of busway
130   interrupted (Ctrl-C) before it was done
====  =============================================================================================================
"""

from enum import IntEnum

from ..errors import BadReply, ConfigError, ExceptionReply, InvalidRequest, LinkDown, ModbusError


class ExitCode(IntEnum):
    """The exit codes that all commands of ``busway`` use; the table at the top of ``exits.py`` has their meanings."""

    DONE = 0
    FAILED = 1
    WRONG_USE = 2
    NO_REPLY = 3
    REFUSED = 4
    NO_CONNECTION = 5
    BROKEN = 6
    NOT_VERIFIED = 7
    OUTPUT_LOST = 8
    DEFECT = 70
    INTERRUPTED = 130


_CODES: tuple[tuple[type[ModbusError], ExitCode], ...] = (
    (InvalidRequest, ExitCode.WRONG_USE),
    (ConfigError, ExitCode.WRONG_USE),
    (ExceptionReply, ExitCode.REFUSED),
    (LinkDown, ExitCode.NO_CONNECTION),
    (BadReply, ExitCode.BROKEN),
)


def exit_code_of(error: ModbusError) -> ExitCode:
    """Return the exit code for an error: 2 wrong use, 4 exception reply, 5 no connection, 6 broken reply.

    All other errors have 3, such as `NoReply`, `WriteOutcomeUnknown` and `Overloaded`.
    """
    return next((code for kind, code in _CODES if isinstance(error, kind)), ExitCode.NO_REPLY)
