"""The text of a file that people write."""

from pathlib import Path

from ..errors import ConfigError


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
