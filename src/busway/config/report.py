"""What components say about the values that a file gives them, each with the line of its key.

Knows how an error of a component names its key; knows no component.
"""

from collections.abc import Callable, Iterable
from typing import TypeVar

from ..errors import ConfigError
from .files.lines import Path
from .files.problems import FileError
from .files.schema import Source, in_order

Made = TypeVar("Made")


class Judge:
    """Collects what is wrong, so that all of it is said at once.

    Args:
        source: the file.

    Attributes:
        problems: what is wrong so far.
        warnings: what is odd, but can be.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.problems: list[ConfigError] = []
        self.warnings: list[ConfigError] = []

    def make(self, make: Callable[[], Made], place: Callable[[str | None], Path]) -> Made | None:
        """What ``make`` gives, or None where it refuses; ``place`` says where the key stands that it names."""
        try:
            return make()
        except FileError as error:
            self.problems += error.problems
        except ConfigError as error:
            self.problems.append(self._source.problem(place(error.key), error.message))
        return None

    def refuse(self, path: Path, sentence: str) -> None:
        """Something is wrong."""
        self.problems.append(self._source.problem(path, sentence))

    def warn(self, path: Path, sentence: str) -> None:
        """Something is odd."""
        self.warnings.append(self._source.problem(path, f"warning: {sentence}"))

    def end(self) -> tuple[ConfigError, ...]:
        """The warnings. Raises `FileError` if anything is wrong."""
        if self.problems:
            raise FileError(in_order(self.problems))
        return tuple(in_order(self.warnings))


def nearest(key: str | None, own: Iterable[str], at: Path, general: Iterable[str], elsewhere: Path) -> Path:
    """Where a key stands: among a part's own keys, or among those for all parts, or else the part itself."""
    if key is not None and key in own:
        return (*at, key)
    if key is not None and key in general:
        return (*elsewhere, key)
    return at
