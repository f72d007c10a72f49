"""Files that commands read, and capture files that they write.

Knows paths; what a file means is known where its schema stands (`busway.config.files`, `busway.observe`).
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ..assembly.reading import read_text
from ..errors import ConfigError

if TYPE_CHECKING:
    from ..observe.capture import Capture


def open_capture(name: str) -> "Capture":
    """A new capture file, which takes the place of an old one. Raises `ConfigError` that names the file."""
    from ..observe.capture import Capture

    try:
        return Capture(Path(name).open("wb"))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"can not be written: {reason[:1].lower()}{reason[1:]}", file=name) from error


__all__ = ["capturing", "open_capture", "read_text"]


@contextlib.contextmanager
def capturing(name: str | None) -> Iterator[None]:
    """Write what links and servers receive and send meanwhile into a capture file; nothing where there is no name.

    Raises:
        ConfigError: the file can not be written.
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
