"""The blocking and the asyncio client with one interface, so that a test is written once and run with both.

The event loop of an asyncio link runs only during a call: what arrives between two calls waits in the socket, as in a
busy program.
"""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import busway


class ClientKind:
    """How links of one kind are opened and asked. ``name`` is ``blocking`` or ``asyncio``."""

    name = ""

    @contextmanager
    def link(self, endpoint: str, **options: Any) -> Iterator["AnyLink"]:
        """A link that is closed when the block is left."""
        raise NotImplementedError
        yield


@dataclass
class AnyLink:
    """A link of either kind, whose methods wait for their results.

    Attributes:
        real: the link itself.
    """

    real: Any
    runner: asyncio.Runner | None = None

    @property
    def counters(self) -> Any:
        """As of the link."""
        return self.real.counters

    @property
    def state(self) -> str:
        """As of the link."""
        return str(self.real.state)

    def unit(self, number: int | None = None) -> "AnyUnit":
        """As of the link."""
        return AnyUnit(self, self.real.unit(number))

    def connect(self) -> None:
        """As of the link."""
        self.call(self.real.connect)

    def breathe(self) -> None:
        """Let the link notice what has happened to its connection, as a loop that runs all the time does."""
        if self.runner is not None:
            self.runner.run(_turns())

    def call(self, function: Any, /, *arguments: Any, **options: Any) -> Any:
        """Call a method, and wait for what it promises."""
        if self.runner is None:
            return function(*arguments, **options)

        async def waited() -> Any:
            return await function(*arguments, **options)

        return self.runner.run(waited())


async def _turns() -> None:
    for _ in range(5):
        await asyncio.sleep(0)


class AnyUnit:
    """A unit of either kind."""

    def __init__(self, link: AnyLink, real: Any) -> None:
        self._link = link
        self._real = real

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._real, name)
        return lambda *arguments, **options: self._link.call(method, *arguments, **options)


class BlockingKind(ClientKind):
    """`busway.connect`."""

    name = "blocking"

    @contextmanager
    def link(self, endpoint: str, **options: Any) -> Iterator[AnyLink]:
        with busway.connect(endpoint, **options) as link:
            yield AnyLink(link)


class AsyncioKind(ClientKind):
    """`busway.open`."""

    name = "asyncio"

    @contextmanager
    def link(self, endpoint: str, **options: Any) -> Iterator[AnyLink]:
        with asyncio.Runner() as runner:

            async def opened() -> busway.AsyncLink:
                return busway.open(endpoint, **options)

            link = runner.run(opened())
            try:
                yield AnyLink(link, runner)
            finally:
                runner.run(link.close())


CLIENT_KINDS = (BlockingKind(), AsyncioKind())
