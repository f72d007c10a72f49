"""A parsed TOML file with the line of each key, and its check by a section class.

Knows TOML texts; knows no particular file. `key_lines` finds the lines, `error_wording` words the problems.

A file is read as a whole, and one error names everything that is wrong with it.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from pydantic import ValidationError

from ...errors import ConfigError
from .error_wording import exhausting_problem, faults_in, syntax_problem
from .file_error import FileError, in_order
from .key_lines import KeyPath, key_lines, line_of
from .section import FileProblems, Section

File = TypeVar("File", bound=Section)


@dataclass(frozen=True, slots=True)
class Source:
    """A parsed TOML file: its data, and the line of each key.

    Attributes:
        name: the file's name, for messages.
        data: its contents.
        lines: the line of each key, table and array element, 1-based, by path: ``("unit", 0, "point", 3, "type")``.
    """

    name: str
    data: Mapping[str, Any]  # what TOML has: any of its types
    lines: Mapping[KeyPath, int]

    def problem(self, path: KeyPath, sentence: str) -> ConfigError:
        """Return an error about a path of the file, with file name, line and key; it is not raised here.

        If the file does not have the path, the line is that of the nearest key or table around it; 1 if there is none.
        """
        standing = _standing(path, self.lines)
        return ConfigError(sentence, file=self.name, line=line_of(self.lines, standing), key=_written(standing))

    def checked(self, schema: type[File], *at: str | int) -> File:
        """Return the content of the file, or one part of it, as a checked object of a schema class.

        Args:
            schema: the class.
            at: keys and indexes that lead to the part, which must be there; none for the whole file.

        Raises:
            FileError: the content is invalid; has all problems, each with its line.
        """
        part: Any = self.data  # what TOML has
        for key in at:
            part = part[key]
        try:
            return schema.model_validate(part)
        except ValidationError as error:
            found = (self.problem((*at, *path), sentence) for path, sentence in faults_in(error, schema))
            raise FileError(in_order(found)) from None


def read_source(text: str, name: str) -> Source:
    """Parse a TOML text, and return its data with the line of each key. Raises `FileError` if it is no TOML."""
    try:
        return Source(name, tomllib.loads(text), key_lines(text))
    except tomllib.TOMLDecodeError as error:
        raise FileError([syntax_problem(text, error, name)]) from error
    except (ValueError, RecursionError) as error:
        raise FileError([exhausting_problem(text, error, name)]) from error


def with_unit(source: Source, unit: int | None) -> Source:
    """Return a copy of a file whose only ``[[unit]]`` gets the number ``unit``, if it has no key ``unit`` itself.

    Otherwise, and if ``unit`` is None, the file is returned unchanged. So a device file with one device can leave its
    number to the command line.
    """
    sections = source.data.get("unit")
    if unit is None or not isinstance(sections, list) or len(sections) != 1:
        return source
    (section,) = sections
    if not isinstance(section, dict) or "unit" in section:
        return source
    return replace(source, data={**source.data, "unit": [{"unit": unit, **section}]})


def parse_with_source(text: str, schema: type[File], name: str) -> tuple[File, Source]:
    """Parse a TOML text and check it by a schema class; returns the checked file, and the `Source` with its lines.

    Args:
        text: the file's text, in TOML.
        schema: the class that describes the file's sections and keys.
        name: the file's name, for messages.

    Raises:
        FileError: the file is invalid; has all problems, each with file, line and key.
    """
    source = read_source(text, name)
    return source.checked(schema), source


def parse_file(text: str, schema: type[File], name: str) -> File:
    """Parse a TOML text and check it by a schema class; returns the checked file.

    Args:
        text: the file's text, in TOML.
        schema: the class that describes the file's sections and keys.
        name: the file's name, for messages.

    Raises:
        FileError: the file is invalid; has all problems, each with file, line and key.
    """
    return parse_with_source(text, schema, name)[0]


def read_section(schema: type[File], data: object) -> File:
    """Check a part of a file by a section class that the caller has chosen by its contents, and return it.

    Raises:
        FileProblems: the part is invalid.
    """
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        raise FileProblems(faults_in(error, schema)) from None


def _standing(path: KeyPath, lines: Mapping[KeyPath, int]) -> KeyPath:
    """Return the path under which the file has a value, for a path of the checked data.

    A key that takes one value or a list has an index in the path, but not in the file if one value is written there.
    """
    if path in lines:
        return path
    shorter = (path[:at] + path[at + 1 :] for at in reversed(range(len(path))))
    return next((each for each in shorter if each in lines and isinstance(path[-1], int)), path)


def _written(path: KeyPath) -> str | None:
    """Return the path of a key as text: ``unit[0].point[3].type``; None for an empty path."""
    text = ""
    for each in path:
        text += f"[{each}]" if isinstance(each, int) else f".{each}" if text else each
    return text or None
