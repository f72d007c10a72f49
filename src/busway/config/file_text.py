"""Reads the text of a configuration file, and refuses one that is not UTF-8 or is too large."""

from typing import Final

from ..errors import ConfigError
from ..safe_files import read_safely, size_text

MOST_BYTES: Final = 32 * 1024 * 1024
"""Most bytes of a configuration file: several times what the largest allowed policy needs."""


def read_text(name: str) -> str:
    """Return the text of a UTF-8 file that the command line or the program names; a pipe is allowed.

    Raises:
        ConfigError: the file cannot be read, is larger than `MOST_BYTES`, or is no UTF-8; ``file`` of the error is its
            path.
    """
    try:
        with open(name, "rb") as file:
            data = file.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"cannot be read: {reason[:1].lower()}{reason[1:]}", file=name) from error
    if len(data) > MOST_BYTES:
        raise ConfigError(f"is larger than {size_text(MOST_BYTES)}, the limit for such a file", file=name)
    return _decoded(data, name)


def read_named_text(name: str) -> str:
    """Return the text of a UTF-8 file that another file names, which must be a regular file.

    The path must not lead through a symbolic link of another user (root excepted), who could choose what is read.

    Raises:
        ConfigError: the file cannot be read, is larger than `MOST_BYTES`, is no UTF-8, is no regular file, or is
            reached through such a link; ``file`` of the error is its path.
    """
    return _decoded(read_safely(name, most=MOST_BYTES), name)


def _decoded(data: bytes, name: str) -> str:
    try:
        # Line ends as they are: the TOML reader checks them.
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"byte 0x{data[error.start]:02X} is no UTF-8", file=name, line=line) from error
