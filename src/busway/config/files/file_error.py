"""The error that holds all problems of one invalid file, a line each. `error_wording` words them."""

from collections.abc import Iterable, Sequence

from ...errors import ConfigError


class FileError(ConfigError):
    """Error: a file cannot be used; has all its problems, each with line and key.

    Attributes:
        problems: what is wrong, each an error with file, line and key, in the order given; at least one. ``message``,
            ``file``, ``line`` and ``key`` of this error are those of the first.
    """

    def __init__(self, problems: Sequence[ConfigError]) -> None:
        first = problems[0]
        super().__init__(first.message, file=first.file, line=first.line, key=first.key)
        self.problems: tuple[ConfigError, ...] = tuple(problems)

    def __str__(self) -> str:
        return "\n".join(str(each) for each in self.problems)


def in_order(problems: Iterable[ConfigError]) -> list[ConfigError]:
    """Return problems of a file sorted by line, those without a line first; equal ones (line, key, message) once."""
    once = {(each.line, each.key, each.message): each for each in problems}
    return sorted(once.values(), key=lambda each: each.line or 0)
