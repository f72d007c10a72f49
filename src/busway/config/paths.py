"""Paths that stand in a configuration file: those of the system, or relative to the file's folder."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from ..options.declaration import Mark, declared
from ..options.tls import TlsParameters

TLS_FILES: Final = tuple(name for name, option in declared(TlsParameters).items() if Mark.FILE in option.marks)
"""Options of `TlsParameters` that are paths."""


def rooted(options: Mapping[str, Any], name: str) -> dict[str, Any]:  # Any: options of several types
    """Options whose paths are no longer relative to the folder of the file of a name."""
    return {
        key: within(name, value) if key in TLS_FILES and isinstance(value, str) else value
        for key, value in options.items()
    }


def within(name: str, path: str) -> str:
    """A path as the file of a name means it."""
    return str(Path(name).parent / path)
