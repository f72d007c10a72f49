"""Reads plain data from YAML by PyYAML (``busway[yaml]``), with the line of each key and item.

1. Data alone: a tag such as ``!include`` would need another program, and is refused with its line.
2. A text has at most `LONGEST` characters, and `MOST_NODES` values where aliases are written out, so that no text
   exhausts time or memory. Keys that merge (``<<``) are refused: they would be copied before they are counted.
"""

from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Final

from ...errors import ConfigError
from ...extras import require

Place = tuple[str | int, ...]
LONGEST: Final = 1_000_000
MOST_NODES: Final = 100_000
_TAG: Final = "tag:yaml.org,2002:"
_CONVERTED: Final = frozenset({"null", "bool", "int", "float"})
_KEPT: Final = frozenset({"str", "timestamp", "value", "seq", "map"})
"""What stays as it is written; dates are texts."""


@dataclass(slots=True)
class YamlDocument:
    """The data of a YAML text, and the line of each key and item."""

    data: Any  # what YAML has
    lines: dict[Place, int] = field(default_factory=dict)

    def line(self, place: Place) -> int:
        """The line of a path in the document, or of the nearest part around it."""
        while place and place not in self.lines:
            place = place[:-1]
        return self.lines.get(place, 1)


def parse_yaml(text: str, name: str) -> YamlDocument:
    """Parse a YAML text. Raises `ConfigError` with file and line if it is invalid or more than plain data."""
    require("yaml", "a file of YAML")
    yaml = import_module("yaml")
    if len(text) > LONGEST:
        raise ConfigError(f"has {len(text)} characters, and {LONGEST} are the limit", file=name)
    try:
        loader = yaml.SafeLoader(text)
        root = loader.get_single_node()
        reader = _Reader(name, loader)
        reader.found.data = None if root is None else reader.value(root, ())
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise ConfigError(str(error.problem), file=name, line=1 if mark is None else mark.line + 1) from error
    except yaml.YAMLError as error:
        raise ConfigError(f"is no YAML: {error}", file=name, line=1) from error
    except RecursionError as error:
        raise ConfigError("is nested too deeply", file=name, line=1) from error
    return reader.found


class _Reader:
    """Turns the nodes of a parsed YAML text into data."""

    def __init__(self, name: str, loader: Any) -> None:  # PyYAML has no types
        self.found = YamlDocument(None)
        self._name, self._loader, self._left = name, loader, MOST_NODES

    def value(self, node: Any, place: Place) -> Any:  # a node of PyYAML, and what YAML has
        """Return a parsed YAML node as plain Python data."""
        self._left -= 1
        kind = node.tag.removeprefix(_TAG)
        if self._left < 0:
            raise self._error(node, f"comes to more than {MOST_NODES} values with all that its aliases stand for")
        if kind not in _CONVERTED | _KEPT:
            raise self._error(node, f"{kind} is not read here; write out what it stands for")
        if node.id == "sequence":
            return [self._inner(each, each, (*place, index)) for index, each in enumerate(node.value)]
        if node.id == "scalar":
            return self._loader.construct_object(node) if kind in _CONVERTED else node.value
        found: dict[str, Any] = {}
        for key, each in node.value:
            if key.id != "scalar" or key.tag == f"{_TAG}merge":
                raise self._error(key, "a key is a text; write out what << merges")
            if key.value in found:
                raise self._error(key, f"{key.value} is there twice")
            found[key.value] = self._inner(key, each, (*place, key.value))
        return found

    def _inner(self, first: Any, node: Any, place: Place) -> Any:
        self.found.lines[place] = first.start_mark.line + 1
        return self.value(node, place)

    def _error(self, node: Any, sentence: str) -> ConfigError:
        return ConfigError(sentence, file=self._name, line=node.start_mark.line + 1)
