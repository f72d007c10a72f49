"""Paths in a configuration file: absolute, or relative to the folder of the file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from ..options.declaration import Mark, declared
from ..options.tls import TlsParameters

TLS_FILES: Final = tuple(name for name, option in declared(TlsParameters).items() if Mark.FILE in option.marks)
"""Names of the options of `TlsParameters` that are paths of files: ``certificate``, ``key`` and so on."""


def rooted(options: Mapping[str, Any], name: str) -> dict[str, Any]:  # Any: options of several types
    """Return a copy of options, with the paths among them (`TLS_FILES`) joined to the folder of the file they are in.

    Absolute paths and all other options stay as they are.

    Args:
        options: options by name.
        name: path of the file that they are in.
    """
    return {
        key: within(name, value) if key in TLS_FILES and isinstance(value, str) else value
        for key, value in options.items()
    }


def within(name: str, path: str) -> str:
    """Return ``path``, given in the file ``name``, joined to the folder of that file; unchanged if absolute."""
    return str(Path(name).parent / path)
