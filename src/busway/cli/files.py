"""Files that people write, read once and whole; and capture files, written.

Knows paths and encodings; what a file means is known where its schema stands (`busway.config.files`, `busway.observe`).
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import ConfigError

if TYPE_CHECKING:
    from ..config.files.device import DeviceFile
    from ..observe.capture import Capture


def read_device_file(name: str) -> "DeviceFile":
    """The device file of a path. Raises `ConfigError`, for all that is wrong with its content with line and key."""
    text = read_text(name)
    from ..config.files.device import parse_device_file

    return parse_device_file(text, name)


def read_text(name: str) -> str:
    """The text of a file in UTF-8. Raises `ConfigError` that names the file."""
    try:
        data = Path(name).read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"can not be read: {reason[:1].lower()}{reason[1:]}", file=name) from error
    try:
        # Line ends as they are: the reader of TOML judges them.
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"byte 0x{data[error.start]:02X} is no UTF-8", file=name, line=line) from error


def open_capture(name: str) -> "Capture":
    """A new capture file, which takes the place of an old one. Raises `ConfigError` that names the file."""
    from ..observe.capture import Capture

    try:
        return Capture(Path(name).open("wb"))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"can not be written: {reason[:1].lower()}{reason[1:]}", file=name) from error


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
