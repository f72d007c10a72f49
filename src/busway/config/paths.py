"""Paths in a configuration file: absolute, or relative to the folder of the file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from ..options.declaration import Mark, declared
from ..options.tls import TlsParameters

TLS_FILES: Final = tuple(name for name, option in declared(TlsParameters).items() if Mark.FILE in option.marks)
"""Names of the options of `TlsParameters` that are paths."""


def rooted(options: Mapping[str, Any], name: str) -> dict[str, Any]:  # Any: options of several types
    """Return options with the paths of certificates (`TLS_FILES`) joined to the folder of the file that has them.

    Args:
        options: options by name.
        name: path of the file.
    """
    return {
        key: within(name, value) if key in TLS_FILES and isinstance(value, str) else value
        for key, value in options.items()
    }


def within(name: str, path: str) -> str:
    """Return a path that the file ``name`` contains, joined to the folder of that file; an absolute one unchanged."""
    return str(Path(name).parent / path)
