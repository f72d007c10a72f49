"""Lines with a foreign server at one end, for our client at the other."""

from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from serial_peers import new_line, start_server, url_of


class ServedLines:
    """Lines with a foreign server each, made when a test first asks for one."""

    def __init__(self, programs: ExitStack) -> None:
        self._programs = programs
        self._urls: dict[str, str] = {}

    def url(self, kind: str) -> str:
        """Where our client reaches the server ``library-framing``: the URL of the other end of its line."""
        if kind not in self._urls:
            line = self._programs.enter_context(new_line())
            self._programs.enter_context(start_server(kind, line.paths[1]))
            self._urls[kind] = url_of(kind.split("-")[1], line.paths[0])
        return self._urls[kind]


@pytest.fixture(scope="session")
def served_lines() -> Iterator[ServedLines]:
    with ExitStack() as programs:
        yield ServedLines(programs)
