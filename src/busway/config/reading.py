"""Reads the text of a configuration file, and refuses one that is not UTF-8."""

from typing import Final

from ..errors import ConfigError
from ..safe_files import read_safely, size_text

MOST_BYTES: Final = 32 * 1024 * 1024
"""Most bytes of a file in TOML: several times a policy with as many rules as are allowed."""


def read_text(name: str) -> str:
    """Return the text of a UTF-8 file that the command line or the program names; it may be a pipe.

    Raises:
        ConfigError: it cannot be read, is larger than `MOST_BYTES`, or is no UTF-8; the error names the file.
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
    """Return the text of a UTF-8 file that another file names; it must be regular and no other user's link.

    Raises:
        ConfigError: as `read_text`, or the file is not regular or another user's link; the error names the file.
    """
    return _decoded(read_safely(name, most=MOST_BYTES), name)


def _decoded(data: bytes, name: str) -> str:
    try:
        # Line ends as they are: the TOML reader checks them.
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"byte 0x{data[error.start]:02X} is no UTF-8", file=name, line=line) from error
