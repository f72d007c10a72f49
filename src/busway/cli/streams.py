"""Standard input, output and error of a command: what happens if one is closed, full, or plain ASCII.

Knows streams; knows no command.

1. A text that stdout does not take ends the command: `OutputLostError`, or `ReaderGoneError` if the reader has gone.
2. A text that stderr does not take is lost: there is no other place to report it.
3. A character that the encoding of a stream does not have is written as ``\\xe4`` or ``\\u2026``.
4. A stream that is closed (``>&-``) is replaced by the null device, so that no socket gets its number.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TextIO, cast


class OutputLostError(Exception):
    """Error: stdout cannot be written, because the disk is full or stdout was closed."""


class ReaderGoneError(Exception):
    """Error: the program that reads stdout has closed it, as in ``busway read … | head -1``.

    It is no `OSError`, because typer would end the program with code 1 for that.
    """


class Guarded:
    """A text stream in place of stdout or stderr that turns failures to write into its own errors, or ignores them.

    Args:
        stream: the stream that it writes to.
        is_needed: True for stdout: a failure raises `ReaderGoneError` or `OutputLostError`. False for stderr: text that
            cannot be written is lost without an error.
    """

    def __init__(self, stream: TextIO, *, is_needed: bool) -> None:
        self._stream = stream
        self._is_needed = is_needed
        self._failure: OSError | ValueError | None = None

    def write(self, text: str) -> int:
        """Write a text to the stream, and return its length in characters.

        After a failure nothing is written any more, and with ``is_needed`` each call raises the error again.

        Raises:
            ReaderGoneError: the reader of stdout has closed it.
            OutputLostError: stdout cannot be written.
        """
        self._do(self._stream.write, text)
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write texts to the stream one after the other; raises the errors of `write`."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush the stream; raises the errors of `write`."""
        self._do(self._stream.flush)

    def __getattr__(self, name: str) -> Any:  # whatever the stream has
        return getattr(self._stream, name)

    def _do(self, act: Callable[..., object], *arguments: str) -> None:
        if self._failure is None:
            try:
                act(*arguments)
            except (OSError, ValueError) as error:
                self._failure = error
                discard(self._stream)
        # Again at each use: libraries try a stream before they use it, and swallow what that raises.
        if self._failure is None or not self._is_needed:
            return
        if isinstance(self._failure, BrokenPipeError):
            raise ReaderGoneError from self._failure
        raise OutputLostError(getattr(self._failure, "strerror", None) or str(self._failure)) from self._failure


@contextlib.contextmanager
def guarded_streams() -> Iterator[None]:
    """Context manager that replaces stdin, stdout and stderr of this process by streams that never fail unexpectedly.

    They follow the rules of this module.
    """
    before = sys.stdin, sys.stdout, sys.stderr
    opened: list[TextIO] = []
    sys.stdin = _there(sys.stdin, "r", opened)
    out = _there(sys.stdout, "w", opened)
    error = _there(sys.stderr, "w", opened)
    _never_fail(sys.stdin, "replace")
    for stream in (out, error):
        _never_fail(stream, "backslashreplace")
    sys.stdout = cast(TextIO, Guarded(out, is_needed=True))
    sys.stderr = cast(TextIO, Guarded(error, is_needed=False))
    try:
        yield
    finally:
        for guarded in (sys.stdout, sys.stderr):
            with contextlib.suppress(OutputLostError, ReaderGoneError):
                guarded.flush()
        sys.stdin, sys.stdout, sys.stderr = before
        for stream in opened:
            stream.close()


def discard(stream: TextIO) -> None:
    """Redirect a stream to the null device, so that flushing what it still buffers cannot fail again."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        null = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(null, stream.fileno())
        finally:
            os.close(null)


def _there(stream: TextIO | None, mode: str, opened: list[TextIO]) -> TextIO:
    """Return ``stream``; if it is None (closed), open the null device instead, and append that to ``opened``."""
    if stream is None:
        stream = cast(TextIO, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115 - it lasts
        opened.append(stream)
    return stream


def _never_fail(stream: TextIO, errors: str) -> None:
    reconfigure = getattr(stream, "reconfigure", None)
    if reconfigure is not None:
        with contextlib.suppress(OSError, ValueError):
            reconfigure(errors=errors)
