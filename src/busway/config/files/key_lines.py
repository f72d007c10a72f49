"""Finds the text line of each key in a TOML file, for error messages, because ``tomllib`` does not report it.

Knows the grammar as far as it separates keys from values; finds no errors: the text must have passed ``tomllib``.

A path is a tuple of keys and, in arrays, indexes: ``("unit", 0, "point", 3, "type")``.
"""

from collections.abc import Mapping
from typing import Final

KeyPath = tuple[str | int, ...]

_SPACE: Final = " \t"
_BLANK: Final = " \t\r\n"
_DELIMITERS: Final = ("'''", '"""', "'", '"')


def key_lines(text: str) -> dict[KeyPath, int]:
    """Return the 1-based line of every key, table and array element in a valid TOML text, by its path."""
    reader = _Reader(text)
    reader.read_document()
    return reader.lines


def line_of(lines: Mapping[KeyPath, int], path: KeyPath) -> int:
    """Return the 1-based line of a path; if the file does not have it, the line of the nearest key around it.

    1 if the file has no key around it either.

    Args:
        lines: the line of each key, table and array element, as `key_lines` returns them.
        path: keys and indexes from the top of the file: ``("unit", 0, "point", 3, "type")``.
    """
    while path and path not in lines:
        path = path[:-1]
    return lines.get(path, 1)


class _Reader:
    """One pass over a TOML text that records the line of each key.

    Attributes:
        lines: the lines so far, 1-based, by path.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._line = 1
        self._tables: dict[KeyPath, int] = {}
        """Number of elements that each array of tables has so far, by the path of the array."""
        self.lines: dict[KeyPath, int] = {}

    def read_document(self) -> None:
        """Read the whole TOML text, and record the line of each key in ``lines``."""
        table: KeyPath = ()
        while True:
            self._skip_blank()
            if self._at >= len(self._text):
                return
            if self._text.startswith("[[", self._at):
                table = self._read_header(2)
            elif self._text[self._at] == "[":
                table = self._read_header(1)
            else:
                self._read_pair(table)

    def _read_header(self, brackets: int) -> KeyPath:
        line = self._line
        self._move(brackets)
        keys = self._read_key()
        self._skip(_SPACE)
        self._move(brackets)
        path: KeyPath = ()
        for position, key in enumerate(keys):
            path = (*path, key)
            if brackets == 2 and position == len(keys) - 1:
                self._tables[path] = self._tables.get(path, 0) + 1
            if path in self._tables:
                self.lines.setdefault(path, line)
                path = (*path, self._tables[path] - 1)
            self.lines.setdefault(path, line)
        return path

    def _read_pair(self, table: KeyPath) -> None:
        line = self._line
        path = table
        for key in self._read_key():
            path = (*path, key)
            self.lines.setdefault(path, line)
        self._skip(_SPACE)
        self._move(1)  # =
        self._skip(_SPACE)
        self._read_value(path)

    def _read_key(self) -> list[str]:
        """Read a TOML key, such as ``server.port``, and return its parts."""
        keys = []
        while True:
            self._skip(_SPACE)
            if self._text[self._at] in "'\"":
                keys.append(self._read_string())
            else:
                start = self._at
                while self._at < len(self._text) and (self._text[self._at].isalnum() or self._text[self._at] in "-_"):
                    self._at += 1
                keys.append(self._text[start : self._at])
            self._skip(_SPACE)
            if self._text[self._at : self._at + 1] != ".":
                return keys
            self._move(1)

    def _read_value(self, path: KeyPath) -> None:
        first = self._text[self._at : self._at + 1]
        if first == "[":
            self._move(1)
            index = 0
            self._skip_blank()
            while self._text[self._at] != "]":
                self.lines.setdefault((*path, index), self._line)
                self._read_value((*path, index))
                index += 1
                self._skip_separator()
            self._move(1)
        elif first == "{":
            self._move(1)
            self._skip_blank()
            while self._text[self._at] != "}":
                self._read_pair(path)
                self._skip_separator()
            self._move(1)
        elif first in ("'", '"'):
            self._read_string()
        else:
            while self._at < len(self._text) and self._text[self._at] not in ",]}#\r\n":
                self._at += 1

    def _read_string(self) -> str:
        """Read a string of any of TOML's four kinds, and return its characters as written; escapes are not decoded."""
        mark = next(each for each in _DELIMITERS if self._text.startswith(each, self._at))
        self._move(len(mark))
        start = self._at
        while not self._text.startswith(mark, self._at):
            self._move(2 if self._text[self._at] == "\\" and mark[0] == '"' else 1)
        content = self._text[start : self._at]
        self._move(len(mark))
        # A multi-line string may end in up to two quotation marks of its own.
        while len(mark) == 3 and self._text[self._at : self._at + 1] == mark[0]:
            self._move(1)
        return content

    def _skip_separator(self) -> None:
        self._skip_blank()
        if self._text[self._at] == ",":
            self._move(1)
            self._skip_blank()

    def _skip_blank(self) -> None:
        """Skip spaces, line ends and comments of the TOML text."""
        while self._at < len(self._text):
            if self._text[self._at] == "#":
                while self._at < len(self._text) and self._text[self._at] != "\n":
                    self._at += 1
            elif self._text[self._at] in _BLANK:
                self._move(1)
            else:
                return

    def _skip(self, characters: str) -> None:
        while self._at < len(self._text) and self._text[self._at] in characters:
            self._at += 1

    def _move(self, count: int) -> None:
        self._line += self._text.count("\n", self._at, self._at + count)
        self._at += count
