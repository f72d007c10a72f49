"""Writes the types of the options of `connect`, `open` and `serve…` from the parameter classes. ``--check``: compares.

Knows dataclasses and annotations; an option that is added to a parameter class has a type here after the next run.
"""

import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import fields
from enum import Enum
from types import NoneType
from typing import Any, get_args, get_type_hints

from marked import ROOT, update

from busway.client.management import ManagementParameters
from busway.framing.timing import Parity
from busway.options.presets import Preset
from busway.options.text import ALIASES
from busway.server.parameters import ListenerParameters
from busway.session.breaker import BreakerParameters
from busway.session.line_framing import FramingParameters
from busway.session.parameters import ClientParameters, ServerParameters
from busway.session.serial_client import SerialClientParameters
from busway.transport.serial.opening import OpeningParameters
from busway.transport.serial.settings import SerialSettings
from busway.transport.tcp import SocketParameters
from busway.transport.tls.parameters import OF_SERVERS, TlsParameters

LINKS = (
    ClientParameters,
    SocketParameters,
    ManagementParameters,
    TlsParameters,
    SerialClientParameters,
    BreakerParameters,
    FramingParameters,
    SerialSettings,
    OpeningParameters,
)
"""What `busway.connect` and `busway.open` take, all schemes together."""
SERVERS = (ServerParameters, ListenerParameters, SocketParameters)
"""What `busway.serve` takes."""

HEAD = '''"""{title}

Written by ``scripts/option_types.py`` from the parameter classes, which say what each option means.
"""

{imports}


class {name}(TypedDict, total=False):
    """{doc}"""

{keys}
'''


class Source:
    """One file of types, as it is put together."""

    def __init__(self, package: str) -> None:
        self._package = package
        self._imports: dict[str, set[str]] = {"typing": {"TypedDict"}}

    def keys(self, kinds: Sequence[type[Any]], *, without: Iterable[str] = ()) -> dict[str, str]:
        """The options of parameter classes, each with the text of its type."""
        found: dict[str, str] = {}
        for kind in kinds:
            hints = get_type_hints(kind)
            for field in fields(kind):
                if field.name not in without:
                    found[field.name] = self.text(hints[field.name])
        return found

    def text(self, hint: Any) -> str:
        """The annotation of what may be given for a type."""
        kinds = get_args(hint) or (hint,)
        return " | ".join(text for kind in kinds for text in self._texts(kind))

    def _texts(self, kind: Any) -> list[str]:
        if kind is NoneType:
            return ["None"]
        if kind.__module__ == "builtins":
            return [str(kind.__name__)]
        self._import(kind.__module__, kind.__name__)
        if issubclass(kind, Enum):
            words = [str(one.value) for one in kind]
            if kind is Parity:
                words += [word[0].upper() for word in words]
            self._imports["typing"].add("Literal")
            return [kind.__name__, f"Literal[{', '.join(map(repr, words))}]"]
        return [kind.__name__, "list[str]", "tuple[str, ...]", "str"]  # what is made of a list of texts

    def _import(self, module: str, name: str) -> None:
        parts = module.split(".")[1:]
        there = f".{parts[1]}" if parts[0] == self._package else f"..{'.'.join(parts)}"
        self._imports.setdefault(there, set()).add(name)

    def render(self, name: str, title: str, doc: str, keys: dict[str, str]) -> str:
        """The whole file, formatted."""
        imports = "\n".join(f"from {there} import {', '.join(sorted(names))}" for there, names in self._imports.items())
        lines = "\n".join(f"    {key}: {text}" for key, text in keys.items())
        raw = HEAD.format(title=title, imports=imports, name=name, doc=doc, keys=lines)
        for command in (["check", "--select", "I", "--fix-only", "--quiet"], ["format", "--quiet"]):
            words = [sys.executable, "-m", "ruff", *command, "--stdin-filename", "src/busway/x.py", "-"]
            raw = subprocess.run(words, cwd=ROOT, input=raw, capture_output=True, text=True, check=True).stdout
        return raw


def link_options() -> str:
    """``client/option_types.py``."""
    source = Source("client")
    keys = source.keys(LINKS, without=OF_SERVERS)
    keys["preset"] = source.text(Preset)
    keys |= {alias: keys[name] for alias, name in ALIASES.items()}
    return source.render(
        "LinkOptions",
        "The options of `busway.connect` and `busway.open`, for type checkers.",
        "What `busway.connect` and `busway.open` take by name; each scheme takes a part of it.",
        keys,
    )


def server_options() -> str:
    """``server/option_types.py``."""
    source = Source("server")
    keys = source.keys(SERVERS)
    keys["preset"] = source.text(Preset)
    keys["standard_port"] = "bool"
    return source.render(
        "ServerOptions",
        "The options of `busway.serve`, for type checkers.",
        "What `busway.serve` takes by name beside its own arguments.",
        keys,
    )


if __name__ == "__main__":
    update(ROOT / "src" / "busway" / "client" / "option_types.py", link_options())
    update(ROOT / "src" / "busway" / "server" / "option_types.py", server_options())
