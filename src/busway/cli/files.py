"""Files that commands read; new files and capture files that they write.

Knows paths; the meaning of a file is known where its schema is (`busway.config.files`, `busway.observe`).
"""

import contextlib
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from ..config.file_text import read_text
from ..errors import ConfigError

if TYPE_CHECKING:
    from ..observe.capture import Capture

PRIVATE: Final = 0o600
"""Access rights of capture files, which contain the traffic of devices: only the owner may read and write."""


def open_capture(name: str) -> "Capture":
    """Create a capture file that only its owner can read (0600), replacing an older capture file.

    Raises:
        ConfigError: the file cannot be written or made private, is reached by a link of another user, or is no capture
            file of busway; the error names the file.
    """
    from ..observe.capture import Capture, is_capture
    from ..safe_files import open_to_replace

    stream = os.fdopen(open_to_replace(name, is_ours=is_capture, kind="capture of busway", mode=PRIVATE), "wb")
    try:
        if hasattr(os, "fchmod"):
            os.fchmod(stream.fileno(), PRIVATE)  # an older file may be one that others can read
        return Capture(stream)
    except (OSError, ValueError) as error:
        with contextlib.suppress(OSError):
            stream.close()
        raise cannot_be_written(name, error) from error


def refuse_to_replace(path: str, *, force: bool) -> None:
    """Raise `ConfigError` if the file ``path`` exists and ``force`` is False.

    Commands call it first, so that nothing is done in vain; `write_new` checks again.
    """
    if not force and os.path.lexists(path):
        raise _there_already(path)


def write_new(path: str, text: str, *, force: bool, kind: str) -> None:
    """Write a new text file; an existing file is replaced only with ``force``.

    Args:
        path: the file.
        text: its contents, written as UTF-8.
        force: whether an existing file may be replaced.
        kind: what is written, such as ``recording``, for the error.

    Raises:
        ConfigError: the file exists and ``force`` is False, or it cannot be written; the error names the file.
    """
    from ..safe_files import open_to_replace, past_links

    try:
        if force:
            handle = open_to_replace(path, is_ours=lambda head: True, kind=kind)
        else:
            handle = os.open(past_links(path), os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:  # it came in the meantime
        raise _there_already(path) from error
    except (OSError, ValueError) as error:
        raise cannot_be_written(path, error) from error


def cannot_be_written(path: str, error: OSError | ValueError) -> ConfigError:
    """Return the error that says why a file cannot be written, for the caller to raise; it names the file."""
    reason = getattr(error, "strerror", None) or str(error)
    return ConfigError(f"cannot be written: {reason[:1].lower()}{reason[1:]}", file=path)


def _there_already(path: str) -> ConfigError:
    return ConfigError("is there already; --force writes over it", file=path)


__all__ = ["cannot_be_written", "capturing", "open_capture", "read_text", "refuse_to_replace", "write_new"]


@contextlib.contextmanager
def capturing(name: str | None) -> Iterator[None]:
    """Context manager that records the traffic of all links and servers of this process in a capture file.

    Args:
        name: path of the capture file; None records nothing.

    Raises:
        ConfigError: the file cannot be written, or exists and is no capture file of busway.
    """
    if name is None:
        yield
        return
    from ..observe.trace import TRACE

    with open_capture(name) as capture:
        TRACE.capture_into(capture)
        try:
            yield
        finally:
            TRACE.capture_into(None)
