"""The names of pymodbus' modules in all its releases, and which module of this package has their contents.

1. A name in `OWN` gives the module of this package with that name. A name in `HOMES` gives a module with the attributes
   of the modules listed there.
2. All these names can be imported below this package, and after `serve_as` below ``pymodbus`` too; both give the same
   objects.
"""

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

HERE = __name__.rpartition(".")[0]
OWN = frozenset(
    {"calls", "client", "constants", "datastore", "device", "exceptions", "framer", "payload", "pdu", "server"}
)
"""Names of the modules of this package: those with pymodbus' names, and `calls`."""
MESSAGES = (
    "bit_message",
    "bit_read_message",
    "bit_write_message",
    "diag_message",
    "file_message",
    "mei_message",
    "other_message",
    "register_message",
    "register_read_message",
    "register_write_message",
)
HOMES: dict[str, tuple[str, ...]] = {
    **{f"{folder}{name}": ("pdu",) for folder in ("", "pdu.") for name in MESSAGES},
    "pdu.pdu": ("pdu",),
    "pdu.exceptionresponse": ("pdu",),
    "client.mixin": ("calls",),
    **{f"client.{name}": ("client",) for name in ("base", "tcp", "udp", "serial", "tls", "sync", "asynchronous")},
    **{f"framer.{name}": ("framer",) for name in ("base", "rtu", "ascii", "socket", "tls")},
    **{f"framer.{name}_framer": ("framer",) for name in ("rtu", "ascii", "socket", "tls")},
    **{f"datastore.{name}": ("datastore",) for name in ("context", "sequential", "sparse", "store")},
    **{f"server.{name}": ("server",) for name in ("async_io", "base", "server", "startstop", "sync", "asynchronous")},
    "pdu.device": ("device",),
    "transaction": ("framer",),
    "utilities": ("calls",),
}
"""Names of pymodbus' modules that this package does not have, and the modules here that have their contents."""
PACKAGES = frozenset(name.partition(".")[0] for name in HOMES if "." in name)
"""Names of modules of pymodbus that have modules below them, such as ``client`` of ``client.tcp``."""


class AliasFinder(MetaPathFinder, Loader):
    """Finder and loader for Python's import system: finds pymodbus' modules below one package name.

    Args:
        root: the package name, such as ``pymodbus``.
    """

    def __init__(self, root: str) -> None:
        self.root: str = root

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the import specification of a pymodbus module below ``root``; None for other names.

        Called by ``import``, which then asks other finders if the result is None.
        """
        root, _, name = fullname.partition(f"{self.root}.")
        if root or not name or name not in OWN | HOMES.keys() or (name in OWN and self.root == HERE):
            return None
        return ModuleSpec(fullname, self, is_package=name in PACKAGES)

    def create_module(self, spec: ModuleSpec) -> None:
        """Return None, so that the import system creates the module."""

    def exec_module(self, module: ModuleType) -> None:
        """Fill a module of pymodbus that is being imported, from modules of this package. Called by ``import``.

        A name in `OWN` gives the module of this package itself; a name in `HOMES` gets copies of attributes.
        """
        name = module.__name__.removeprefix(f"{self.root}.")
        if name in OWN:
            sys.modules[module.__name__] = import_module(f"{HERE}.{name}")
            return
        for home in HOMES[name]:
            contents = vars(import_module(f"{HERE}.{home}"))
            module.__dict__.update({key: value for key, value in contents.items() if not key.startswith("__")})


def serve_below(root: str) -> None:
    """Make imports of pymodbus' modules below the package name ``root`` find the modules of this package.

    A second call with the same name does nothing.
    """
    if not any(isinstance(finder, AliasFinder) and finder.root == root for finder in sys.meta_path):
        sys.meta_path.append(AliasFinder(root)) if root == HERE else sys.meta_path.insert(0, AliasFinder(root))
