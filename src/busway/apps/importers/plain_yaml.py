"""Reads plain data from YAML by PyYAML (``busway[yaml]``), with the line of each key and list item.

1. Only plain data are read. A tag such as ``!include`` has a meaning in one program only, and is refused with its line.
2. A text has at most `LONGEST` characters and `MOST_NODES` values, and a number `LONGEST_NUMBER` characters, so that no
   text exhausts time or memory; what an alias refers to is counted each time. Merge keys (``<<``) are refused: PyYAML
   would copy their values before they are counted.
"""

from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Final

from ...config.files.key_lines import KeyPath
from ...errors import ConfigError
from ...extras import require
from ...values.unfit_values import shown

LONGEST: Final = 1_000_000
MOST_NODES: Final = 100_000
LONGEST_NUMBER: Final = 1000
"""Most characters of a number. The time to convert one of base 60, ``1:30:00``, grows with the square of its length."""
_TAG: Final = "tag:yaml.org,2002:"
_CONVERTED: Final = frozenset({"null", "bool", "int", "float"})
_KEPT: Final = frozenset({"str", "timestamp", "value", "seq", "map"})
"""YAML types that need no conversion: lists, mappings, and scalars that stay texts as written, such as dates."""


@dataclass(slots=True)
class YamlDocument:
    """The data of a YAML text, and the line of each key and list item.

    Attributes:
        data: dictionaries, lists, texts, numbers, booleans and None; None for an empty document. All keys are texts.
        lines: line numbers from 1, by path: a tuple of keys and list indices from the root.
    """

    data: Any  # what YAML has
    lines: dict[KeyPath, int] = field(default_factory=dict)

    def line(self, place: KeyPath) -> int:
        """Return the line number of a path, or of the nearest part of the document around it; 1 if there is none."""
        while place and place not in self.lines:
            place = place[:-1]
        return self.lines.get(place, 1)


def parse_yaml(text: str, name: str) -> YamlDocument:
    """Parse a YAML text that has only plain data.

    Args:
        text: the YAML text.
        name: the file's name, for errors.

    Raises:
        ConfigError: the text is no YAML, has several documents or more than plain data, or is too large; or PyYAML is
            not installed.
    """
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
    """Converts the nodes that PyYAML has parsed into a `YamlDocument`, which is in its attribute ``found``."""

    def __init__(self, name: str, loader: Any) -> None:  # PyYAML has no types
        self.found = YamlDocument(None)
        self._name, self._loader, self._left = name, loader, MOST_NODES

    def value(self, node: Any, place: KeyPath) -> Any:  # a node of PyYAML, and what YAML has
        """Return a parsed YAML node as plain Python data, and store the lines of its parts in ``found``.

        Args:
            node: a node of PyYAML.
            place: path of the node from the root.

        Raises:
            ConfigError: the node has a tag that is not plain data, a value that does not fit its tag, a merge key, a
                repeated key or a key that is no text; or the text has too many values.
        """
        self._left -= 1
        kind = node.tag.removeprefix(_TAG)
        if self._left < 0:
            raise self._error(node, f"comes to more than {MOST_NODES} values with all that its aliases stand for")
        if kind not in _CONVERTED | _KEPT:
            raise self._error(node, f"{kind} is not read here; write out what it stands for")
        if node.id == "sequence":
            return [self._inner(each, each, (*place, index)) for index, each in enumerate(node.value)]
        if node.id == "scalar":
            return self._converted(node, kind) if kind in _CONVERTED else node.value
        found: dict[str, Any] = {}
        for key, each in node.value:
            if key.id != "scalar" or key.tag == f"{_TAG}merge":
                raise self._error(key, "a key is a text; write out what << merges")
            if key.value in found:
                raise self._error(key, f"{key.value} is there twice")
            found[key.value] = self._inner(key, each, (*place, key.value))
        return found

    def _converted(self, node: Any, kind: str) -> Any:
        if len(node.value) > LONGEST_NUMBER:
            raise self._error(node, f"is a number of {len(node.value)} characters, and {LONGEST_NUMBER} are the limit")
        try:
            return self._loader.construct_object(node)
        except (ValueError, LookupError, OverflowError) as error:  # PyYAML does not check what a tag is put before
            raise self._error(node, f"{shown(node.value)} cannot be read as {kind}") from error

    def _inner(self, first: Any, node: Any, place: KeyPath) -> Any:
        self.found.lines[place] = first.start_mark.line + 1
        return self.value(node, place)

    def _error(self, node: Any, sentence: str) -> ConfigError:
        return ConfigError(sentence, file=self._name, line=node.start_mark.line + 1)
