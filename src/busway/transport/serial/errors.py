"""Translates errors of serial ports into the errors of busway.

Knows the errors of the system and of `serialx`; knows no Modbus.

1. Errors that may pass (port missing, taken, unplugged) are `LinkDown`; those that stay until the user changes a
   setting are `ConfigError`.
"""

import errno

from ...errors import ConfigError, LinkDown, LinkDownKind
from .lock import holder_of

_REASONS = {
    errno.ENOENT: "it is not there",
    errno.ENODEV: "it is not there (the device was unplugged, or its driver does not run)",
    errno.ENXIO: "it is not there (the device was unplugged, or its driver does not run)",
    errno.EIO: "the device was unplugged or its other end closed",
    errno.EACCES: "this user may not use it; on many systems the members of the group dialout may",
    errno.EPERM: "this user may not use it; on many systems the members of the group dialout may",
    errno.EMFILE: "this process has no file handles left",
}

_KINDS: dict[int, LinkDownKind] = {
    errno.ENOENT: "missing",
    errno.ENOTDIR: "missing",
    errno.ENODEV: "missing",
    errno.ENXIO: "missing",
    errno.EIO: "lost",
    errno.EACCES: "local",
    errno.EPERM: "local",
    errno.EMFILE: "local",
}
_TAKEN = frozenset({errno.EBUSY, errno.EAGAIN})
_IMPOSSIBLE = frozenset({errno.EINVAL, errno.ENOTTY, errno.EISDIR, errno.EOPNOTSUPP})


def opening_failed(error: Exception, *, port: str, settings: str = "") -> LinkDown | ConfigError:
    """Create the error for a port that could not be opened, from the system's error. No byte was sent.

    It is `LinkDown` if the cause can pass (missing, unplugged, held by another program, no permission), and
    `ConfigError` if the path is no serial port or does not accept the settings.

    Args:
        error: the system's error.
        port: the path that was opened.
        settings: the wanted settings of the line in words, for the message.
    """
    number = getattr(error, "errno", None)
    ours: LinkDown | ConfigError
    if number in _TAKEN:
        holder = holder_of(port)
        ours = LinkDown(
            f"{port} cannot be opened: it is held by {holder or 'another program, which does not show'}", kind="taken"
        )
    elif number == errno.ENOTTY:
        ours = ConfigError(f"{port} is not a serial port", key="port")
    elif number in _IMPOSSIBLE or not isinstance(error, OSError):
        ours = ConfigError(f"{port} cannot be set to {settings or 'these settings'} ({_words(error)})", key="port")
    else:
        ours = LinkDown(f"{port} cannot be opened: {_words(error)}", kind=_KINDS.get(number or 0, "other"))
    ours.__cause__ = error
    return ours


def port_lost(error: BaseException | None, *, port: str, sent: bool = False) -> LinkDown:
    """Create the error for a serial port that vanished while it was open.

    Args:
        error: the system's error; None if a read returned the end of the file instead.
        port: its path.
        sent: whether bytes of a request may have left.
    """
    down = LinkDown(f"{port} is lost: {_words(error) if error else _REASONS[errno.EIO]}", kind="lost", sent=sent)
    down.__cause__ = error
    return down


def _words(error: BaseException) -> str:
    return _REASONS.get(getattr(error, "errno", None) or 0) or str(error) or type(error).__name__
