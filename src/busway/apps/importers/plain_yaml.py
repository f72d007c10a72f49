"""A parser for the part of YAML that configurations of Home Assistant use, with the line of each key and item.

Knows mappings and sequences in blocks, and scalars on one line. By hand, because the report needs lines; the rest of
YAML (anchors, tags, blocks of text, flow collections) is refused with its line rather than half understood.
"""

import re
from dataclasses import dataclass, field
from typing import Any, Final

from ...errors import ConfigError

Place = tuple[str | int, ...]
_KEY: Final = re.compile(r"""(?P<key>[A-Za-z_][\w .-]*|"[^"]*"|'[^']*')\s*:(?:\s+(?P<rest>.*))?$""")
_NUMBER: Final = re.compile(r"[+-]?(\d+|0x[0-9a-fA-F]+|\d*\.\d+([eE][+-]?\d+)?|\d+\.\d*([eE][+-]?\d+)?)")
_WORDS: Final = {
    "true": True, "yes": True, "on": True, "false": False, "no": False, "off": False, "null": None, "~": None, "": None,
}  # fmt: skip
_DEEPEST: Final = 40


@dataclass(slots=True)
class YamlDocument:
    """The data of a parsed YAML text, and the line of each key and item."""

    data: Any  # what YAML has
    lines: dict[Place, int] = field(default_factory=dict)

    def line(self, place: Place) -> int:
        """The line of a path in the document, or of the nearest part around it."""
        while place and place not in self.lines:
            place = place[:-1]
        return self.lines.get(place, 1)


@dataclass(frozen=True, slots=True)
class _Line:
    number: int
    indent: int
    text: str


def parse_yaml(text: str, name: str) -> YamlDocument:
    """Parse a YAML text. Raises `ConfigError` with file and line for syntax that is not supported."""
    return _Reader(text, name).document()


class _Reader:
    """Parser of YAML that reads lines with their indentation."""

    def __init__(self, text: str, name: str) -> None:
        self._name = name
        self._lines: list[_Line] = []
        self._at = 0
        self._found = YamlDocument(None)
        for number, line in enumerate(text.splitlines(), 1):
            content = _without_comment(line).rstrip()
            if "\t" in content[: len(content) - len(content.lstrip())]:
                raise self._error(number, "indentation is made of spaces")
            if content.strip() and content.strip() not in ("---", "..."):
                self._lines.append(_Line(number, len(content) - len(content.lstrip(" ")), content.strip()))

    def document(self) -> YamlDocument:
        """Parse the whole YAML document."""
        if self._lines:
            self._found.data = self._block(self._lines[0].indent, (), 0)
            if self._at < len(self._lines):
                raise self._error(self._lines[self._at].number, "is indented as nothing before it")
        return self._found

    def _block(self, indent: int, place: Place, depth: int) -> Any:
        if depth > _DEEPEST:
            raise self._error(self._lines[self._at].number, "is nested too deeply")
        text = self._lines[self._at].text
        return self._sequence(indent, place, depth) if _is_item(text) else self._mapping(indent, place, depth)

    def _sequence(self, indent: int, place: Place, depth: int) -> list[Any]:
        found: list[Any] = []
        while self._at < len(self._lines) and self._lines[self._at].indent == indent:
            line = self._lines[self._at]
            if not _is_item(line.text):
                break
            here = (*place, len(found))
            self._found.lines[here] = line.number
            rest = line.text[1:].lstrip()
            if not rest:
                self._at += 1
                found.append(self._below(indent, here, depth))
            elif _KEY.match(rest) or _is_item(rest):
                inner = indent + len(line.text) - len(rest)
                self._lines[self._at] = _Line(line.number, inner, rest)
                found.append(self._block(inner, here, depth + 1))
            else:
                self._at += 1
                found.append(self._scalar(rest, line.number))
        return found

    def _mapping(self, indent: int, place: Place, depth: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        while self._at < len(self._lines) and self._lines[self._at].indent == indent:
            line = self._lines[self._at]
            match = _KEY.match(line.text)
            if match is None:
                raise self._error(line.number, f"is neither a key nor an item: {line.text[:40]}")
            key = match["key"].strip("\"'")
            if key in found:
                raise self._error(line.number, f"{key} is there twice")
            here = (*place, key)
            self._found.lines[here] = line.number
            self._at += 1
            rest = (match["rest"] or "").strip()
            found[key] = self._scalar(rest, line.number) if rest else self._below(indent, here, depth, key=True)
        return found

    def _below(self, indent: int, place: Place, depth: int, *, key: bool = False) -> Any:
        """Parse a more indented YAML block; a sequence may be indented like its key. None if there is none."""
        if self._at >= len(self._lines):
            return None
        line = self._lines[self._at]
        if line.indent > indent or (key and line.indent == indent and _is_item(line.text)):
            return self._block(line.indent, place, depth + 1)
        return None

    def _scalar(self, text: str, number: int) -> Any:
        if text[0] in "\"'":
            if len(text) < 2 or text[-1] != text[0]:
                raise self._error(number, "has a text that does not end on its line")
            return text[1:-1].replace("''", "'") if text[0] == "'" else text[1:-1].replace('\\"', '"')
        if text[0] in "&*!|>{[%@`":
            if text in ("[]", "{}"):
                return [] if text == "[]" else {}
            raise self._error(number, f"begins with {text[0]}, which is not read here; write it out in plain YAML")
        if text.lower() in _WORDS:
            return _WORDS[text.lower()]
        if _NUMBER.fullmatch(text):
            return int(text, 0) if re.fullmatch(r"[+-]?(0x[0-9a-fA-F]+|0|[1-9]\d*)", text) else float(text)
        return text

    def _error(self, number: int, sentence: str) -> ConfigError:
        return ConfigError(sentence, file=self._name, line=number)


def _is_item(text: str) -> bool:
    return text == "-" or text.startswith("- ")


def _without_comment(line: str) -> str:
    quote = ""
    for place, letter in enumerate(line):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'" and (place == 0 or line[place - 1] in " :-"):
            quote = letter
        elif letter == "#" and (place == 0 or line[place - 1] in " \t"):
            return line[:place]
    return line
