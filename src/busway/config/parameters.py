"""Parameters of device files: names in the file's texts that an include replaces by values.

Knows TOML data and the names of parameters; what a file contains is known by its schema.

1. A text that is ``${name}`` alone becomes the parameter's value, with its type; inside a longer text it becomes its
   text. Between the braces an expression is allowed: ``${base + 10 * index}``. ``$${`` is ``${`` unchanged.
2. ``[parameters]`` of a file gives defaults, and ``required`` lists parameters without a default, which the including
   file has to set. Two names need no declaration inside a ``[[unit]]``: ``unit`` is the number of the unit that is
   created, and ``index`` is its position, from 0 on, among the units that one include creates.
3. The number of characters that are inserted into one text is limited: `LONGEST_TEXT`.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

from ..errors import ConfigError
from ..points.expression import WHOLE_BITS, parse_expression
from ..values.unfit_values import shown
from .files.file_error import FileError
from .files.key_lines import KeyPath
from .files.simulation import Parameter
from .files.toml_source import Source

_INSERT: Final = re.compile(r"\$\{([^{}]*)\}")
_ESCAPED: Final = "$${"
OF_UNITS: Final = ("unit", "index")
LONGEST_TEXT: Final = 10_000
"""Most characters that are inserted into one text: files that insert a parameter twice would double it each time."""


def declared_parameters(
    source: Source, given: Mapping[str, Parameter], asked: tuple[Source, KeyPath] | None
) -> dict[str, Parameter]:
    """Return the parameters of a file with their values, by name: its defaults, overridden by the given values.

    Returns only the given values if ``parameters`` is no table or ``required`` no list; the file's schema reports that.

    Args:
        source: the file that declares the parameters.
        given: values from the include that names the file; empty for a file that is not included.
        asked: the file that includes this one and the path of its include, for errors; None for a file that is not
            included.

    Raises:
        FileError: a name is invalid, a given parameter is not declared, a required one is not given, or a file that is
            not included requires parameters.
    """
    defaults, required = source.data.get("parameters", {}), source.data.get("required", [])
    if not isinstance(defaults, dict) or not isinstance(required, list):
        return dict(given)  # the schema will say what is wrong
    problems = [
        source.problem(("parameters", name), f"{shown(name)} cannot be the name of a parameter")
        for name in defaults
        if not name.isidentifier() or name in OF_UNITS
    ]
    known = [*defaults, *(name for name in required if isinstance(name, str))]
    if asked is not None:
        parent, at = asked
        problems += [
            parent.problem((*at, "with", name), f"{source.name} has no such parameter; {_there_are(known)}")
            for name in given
            if name not in known
        ]
        problems += [
            parent.problem((*at, "with"), f"{source.name} needs {name}")
            for name in required
            if isinstance(name, str) and name not in given
        ]
    elif required:
        problems.append(source.problem(("required",), f"can only be given by who includes this file: {required[0]}"))
    if problems:
        raise FileError(problems)
    return {**defaults, **given}


def _there_are(names: Sequence[str]) -> str:
    return f"there are {', '.join(names)}" if names else "it has none"


class FilledSource:
    """A file and the values of its parameters; `filled` returns its data with the parameters replaced.

    Args:
        source: the file.
        parameters: the values of the parameters, by name.

    Attributes:
        source: the file.
        used: names of the parameters that were inserted so far.
    """

    def __init__(self, source: Source, parameters: Mapping[str, Parameter]) -> None:
        self.source = source
        self.used: set[str] = set()
        self._parameters = dict(parameters)

    def with_more(self, more: Mapping[str, Parameter]) -> "FilledSource":
        """Return a new object for the same file with further parameters; its ``used`` is empty."""
        return FilledSource(self.source, {**self._parameters, **more})

    def filled(self, node: Any, path: KeyPath) -> Any:  # what TOML has
        """Return a copy of a part of the file's data, with parameters in its texts replaced by their values.

        Args:
            node: the part: a value, a list or a table. Keys of tables stay as they are.
            path: its path in the file, for errors.

        Raises:
            FileError: an expression is invalid, a parameter does not exist, or a text becomes too long.
        """
        if isinstance(node, str):
            return self._text(node, path)
        if isinstance(node, list):
            return [self.filled(each, (*path, index)) for index, each in enumerate(node)]
        if isinstance(node, dict):
            return {key: self.filled(each, (*path, key)) for key, each in node.items()}
        return node

    def _text(self, text: str, path: KeyPath) -> Parameter:
        if "${" not in text:
            return text
        whole = _INSERT.fullmatch(text)
        if whole is not None:
            return self._value(whole[1], path)
        parts = text.split(_ESCAPED)
        put_in = 0

        def written(match: re.Match[str]) -> str:
            nonlocal put_in
            try:
                found = _written(self._value(match[1], path))
            except FileError:
                raise
            except ConfigError as error:
                raise FileError([self.source.problem(path, error.message)]) from None
            put_in += len(found)
            if put_in > LONGEST_TEXT:
                sentence = f"more than {LONGEST_TEXT} characters of parameters would be put into it"
                raise FileError([self.source.problem(path, sentence)])
            return found

        return "${".join(_INSERT.sub(written, part) for part in parts)

    def _value(self, text: str, path: KeyPath) -> Parameter:
        name = text.strip()
        try:
            if name not in self._parameters and name.isidentifier():
                raise ConfigError(f"there is no parameter {shown(name)}; {_there_are(list(self._parameters))}")
            if name in self._parameters:
                self.used.add(name)
                return self._parameters[name]
            return self._computed(text)
        except ConfigError as error:
            raise FileError([self.source.problem(path, error.message)]) from None

    def _computed(self, text: str) -> Parameter:
        expression = parse_expression(text)
        values: dict[str, Any] = {}  # parameters that are numbers
        for name in expression.names:
            if name not in self._parameters:
                raise ConfigError(f"there is no parameter {shown(name)}; {_there_are(list(self._parameters))}")
            if not isinstance(self._parameters[name], int | float):
                raise ConfigError(f"{name} is no number, but {shown(self._parameters[name])}")
            self.used.add(name)
            values[name] = self._parameters[name]
        return expression.result(values)


def _written(value: Parameter) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int) and value.bit_length() > WHOLE_BITS:
        raise ConfigError(f"a whole number of {value.bit_length()} bits is put in, and {WHOLE_BITS} are the limit")
    return str(value)


def own_units(filled: FilledSource) -> dict[str, Any]:  # what TOML has
    """Return all data of a file with the parameters replaced by their values; its units keep their own numbers.

    For a file that is not included, or is included without the key ``units``. Inside a ``[[unit]]`` with one number,
    the parameter ``unit`` is that number and ``index`` is 0; elsewhere both do not exist.

    Raises:
        FileError: an expression is invalid, a parameter does not exist, or a text becomes too long.
    """
    data = filled.source.data
    rest: dict[str, Any] = filled.filled({key: value for key, value in data.items() if key != "unit"}, ())
    sections = data.get("unit")
    if isinstance(sections, list):
        rest["unit"] = [_own_unit(filled, section, index) for index, section in enumerate(sections)]
    elif sections is not None:
        rest["unit"] = sections
    return rest


def _own_unit(filled: FilledSource, section: Any, index: int) -> Any:  # what TOML has
    number = section.get("unit") if isinstance(section, dict) else None
    if isinstance(number, list) and len(number) == 1:
        number = number[0]
    if isinstance(number, int) and not isinstance(number, bool):
        filled = filled.with_more({"unit": number, "index": 0})
    return filled.filled(section, ("unit", index))
