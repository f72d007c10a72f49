"""Writes the types of the options of `connect`, `open` and `serve…` from their declarations. ``--check``: compares.

Knows declared options; one that is added has a type here after the next run.
"""

import subprocess
import sys
from collections.abc import Sequence
from enum import Enum
from typing import Any

from marked import ROOT, update

from busway.framing.character_times import Parity
from busway.options.accepted_options import LINKS, SERVERS, AcceptedOptions
from busway.options.declaration import Option
from busway.options.presets import Preset

HEAD = '''"""{title}

Written by ``scripts/option_types.py`` from `busway.options`, where each option is declared.
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

    def keys(self, kinds: Sequence[type[Any]], *, role: str = "") -> dict[str, str]:
        """The options of parameter classes, each with the text of its type."""
        taken = AcceptedOptions.of(*kinds, role=role).options.values()
        found = {one.name: self.text(one) for one in taken}
        return found | {alias: found[one.name] for one in taken for alias in one.aliases}

    def text(self, option: Option) -> str:
        """The annotation of what may be given for an option."""
        texts = [text for kind in option.kinds for text in self.texts(kind)]
        return " | ".join([*texts, "None"] if option.is_optional else texts)

    def texts(self, kind: Any) -> list[str]:
        """The annotations of what may be given for a type."""
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
    keys = source.keys(LINKS, role="client") | {"preset": " | ".join(source.texts(Preset))}
    return source.render(
        "LinkOptions",
        "The options of `busway.connect` and `busway.open`, for type checkers.",
        "Keyword options of `busway.connect` and `busway.open`; the scheme decides which are accepted.",
        keys,
    )


def server_options() -> str:
    """``server/option_types.py``."""
    source = Source("server")
    presets = [text.replace(', "passive"', "") for text in source.texts(Preset)]
    keys = source.keys(SERVERS) | {"preset": " | ".join(presets)}
    return source.render(
        "ServerOptions",
        "The options of `busway.serve`, for type checkers.",
        "What `busway.serve` takes by name beside its own arguments.",
        keys,
    )


if __name__ == "__main__":
    update(ROOT / "src" / "busway" / "client" / "option_types.py", link_options())
    update(ROOT / "src" / "busway" / "server" / "option_types.py", server_options())
