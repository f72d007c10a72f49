"""The error that holds all problems of one invalid file, a line each. `schema` words them; nothing is decided here."""

from collections.abc import Sequence

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
