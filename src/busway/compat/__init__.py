"""Compatibility: the names of other Modbus libraries, on top of busway's own clients and servers.

`pymodbus` and `minimalmodbus` have the interfaces of the libraries of those names. Programs import them from here, or
call `install` before they import a library that needs the original, which then gets these modules instead.

1. The protocol is busway's: each call becomes a request of `busway.pdu` on a link of `busway.client`, each server one
   of `busway.server`.
2. A write is never repeated unless the program asks for it by ``write_retries=``.
"""

import sys
from importlib import import_module
from types import ModuleType

from ..errors import ConfigError

LIBRARIES = ("pymodbus", "minimalmodbus")
"""The names that `install` accepts."""


def install(name: str) -> ModuleType:
    """Make ``import NAME``, and imports of its submodules, give busway's compatible modules. Returns the package.

    Applies to the whole process, from the call on.

    Args:
        name: ``pymodbus`` or ``minimalmodbus``.

    Raises:
        ConfigError: another name, or the original has been imported already; call `install` before.
    """
    if name not in LIBRARIES:
        raise ConfigError(f"there is no compatible module for {name!r}; there are {' and '.join(LIBRARIES)}")
    package = import_module(f".{name}", __name__)
    present = sys.modules.get(name)
    if present is not None and present is not package:
        raise ConfigError(f"{name} is imported already; install comes before the first import of it")
    sys.modules[name] = package
    prepare = getattr(package, "serve_as", None)
    if prepare is not None:
        prepare(name)
    return package
