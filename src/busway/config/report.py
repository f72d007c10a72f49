"""The report of a configuration file's problems, each with the line of its key.

Knows that an error of a component names its key; knows no component.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import TypeVar

from ..errors import ConfigError
from ..options.declaration import Option
from .files.file_error import FileError, in_order
from .files.key_lines import KeyPath
from .files.toml_source import Source

Made = TypeVar("Made")


class ConfigurationReport:
    """Collects problems and warnings of a file, so that one error names all problems.

    Args:
        source: the parsed file, whose name, lines and keys the errors have.

    Attributes:
        problems: the errors found so far, each with file, line and key. `end` raises them.
        warnings: the warnings found so far, each an error object with file, line and key that is never raised.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.problems: list[ConfigError] = []
        self.warnings: list[ConfigError] = []

    def make(self, make: Callable[[], Made], place: Callable[[str | None], KeyPath]) -> Made | None:
        """Return the result of ``make``; None if it raises `ConfigError`, whose problems are added to the report.

        Args:
            make: builds a part of the configuration.
            place: takes the key of an error (None for an error without one), and returns the path in the file at which
                it is reported.
        """
        try:
            return make()
        except FileError as error:
            self.problems += error.problems
        except ConfigError as error:
            self.problems.append(self._source.problem(place(error.key), error.message))
        return None

    def check_numbers(
        self, known: Mapping[str, Option], options: Mapping[str, object], place: Callable[[str | None], KeyPath]
    ) -> None:
        """Add a problem for each number that is out of the range of its option.

        `make` adds the first one only: that of the parameter class, which may add the same problem again.

        Args:
            known: the options that are checked, by name.
            options: their values.
            place: as of `make`.
        """
        for name, value in options.items():
            option = known.get(name)
            if option is not None:
                self.make(partial(option.check_number, value), place)

    def refuse(self, path: KeyPath, sentence: str) -> None:
        """Add a problem to the report: what ``sentence`` says is wrong at ``path`` in the configuration file."""
        self.problems.append(self._source.problem(path, sentence))

    def warn(self, path: KeyPath, sentence: str) -> None:
        """Add a warning to the report, at a path of the configuration file; its message is ``warning: `` + sentence."""
        self.warnings.append(self._source.problem(path, f"warning: {sentence}"))

    def end(self) -> tuple[ConfigError, ...]:
        """Return the warnings about the file, by line. Raises `FileError` with all problems if there are any."""
        if self.problems:
            raise FileError(in_order(self.problems))
        return tuple(in_order(self.warnings))


def nearest(key: str | None, own: Iterable[str], at: KeyPath, general: Iterable[str], elsewhere: KeyPath) -> KeyPath:
    """Return the path in a file at which an error about a key is reported: the section that sets the key.

    A listener, for example, has a section of its own, and ``[security]`` is the common section of all listeners. The
    own section comes first.

    Args:
        key: the key; None for an error without one.
        own: keys that the component's own section sets.
        at: path of the own section; it is the result if neither section sets the key.
        general: keys that the common section sets.
        elsewhere: path of the common section.
    """
    if key is not None and key in own:
        return (*at, key)
    if key is not None and key in general:
        return (*elsewhere, key)
    return at
