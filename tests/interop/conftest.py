"""What the interop tests start: foreign servers and clients, our server with known content, our client as both kinds.

Programs live as long as the tests that share them. So tests read in the lower half of a table, whose content no test
changes, and write in the upper half, each from its own address on; what a test reads there it has written itself.
"""

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import foreign
import pytest

import busway

UNIT = 1


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Every test in this folder needs a program that is not ours."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.interop)


# --- foreign servers --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def libmodbus_server() -> Iterator[foreign.Program]:
    with foreign.c_peer("libmodbus_server", "tcp", 0) as program:
        yield program


@pytest.fixture(scope="session")
def pymodbus_server() -> Iterator[foreign.Program]:
    with foreign.python_peer("pymodbus_server.py", "tcp", 0) as program:
        yield program


@pytest.fixture(scope="session")
def pymodbustcp_server() -> Iterator[foreign.Program]:
    with foreign.python_peer("pymodbustcp_server.py", 0) as program:
        yield program


# --- our client, as both kinds ----------------------------------------------------------------------------------------


class Unit(Protocol):
    """A unit of a link, whose methods wait for their results whatever via is underneath."""

    def __getattr__(self, name: str) -> Callable[..., Any]: ...


class AsyncioUnit:
    """The asyncio client, used from outside its loop: each call runs the loop until it is done."""

    def __init__(self, url: str, runner: asyncio.Runner) -> None:
        self._runner = runner
        self._link = busway.open(url)
        runner.run(self._enter())
        self._unit = self._link.unit(UNIT)

    async def _enter(self) -> None:
        await self._link.__aenter__()

    def __getattr__(self, name: str) -> Callable[..., Any]:
        async def call(*arguments: Any, **options: Any) -> Any:
            return await getattr(self._unit, name)(*arguments, **options)

        return lambda *arguments, **options: self._runner.run(call(*arguments, **options))

    def close(self) -> None:
        """Close the link in its loop."""

        async def leave() -> None:
            await self._link.__aexit__(None, None, None)

        self._runner.run(leave())


@pytest.fixture(params=["blocking", "asyncio"])
def unit_at(request: pytest.FixtureRequest) -> Iterator[Callable[[str], Unit]]:
    """Opens unit 1 of a server by its URL: once with the blocking client, once with the asyncio client."""
    closers: list[Callable[[], None]] = []

    def blocking(url: str) -> Unit:
        link = busway.connect(url)
        link.__enter__()
        closers.append(lambda: link.__exit__(None, None, None))
        unit: Unit = link.unit(UNIT)
        return unit

    def on_a_loop(url: str) -> Unit:
        runner = asyncio.Runner()
        closers.append(runner.close)
        unit = AsyncioUnit(url, runner)
        closers.append(unit.close)
        return unit

    yield blocking if request.param == "blocking" else on_a_loop
    for close in reversed(closers):
        close()


# --- our server, and foreign clients on it ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def our_url() -> Iterator[str]:
    """Our server with a device of the known content; the URL at which it answers."""
    device = busway.Device(
        **foreign.CONTENT, identification=foreign.IDENTITY, files={4: {7: [0, 0, 0]}}, fifos={40: [440, 4740]}
    )
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={UNIT: device}) as server:
        yield server.endpoints[0]


@pytest.fixture(scope="module")
def our_port(our_url: str) -> int:
    return int(our_url.rpartition(":")[2])


@pytest.fixture(scope="module")
def libmodbus_client(our_port: int) -> Iterator[foreign.Program]:
    with foreign.c_peer("libmodbus_client", "tcp", "127.0.0.1", our_port, UNIT) as program:
        yield program


@pytest.fixture(scope="module")
def pymodbus_client(our_port: int) -> Iterator[foreign.Program]:
    with foreign.python_peer("pymodbus_client.py", "tcp", "127.0.0.1", our_port, UNIT) as program:
        yield program


@pytest.fixture(scope="module")
def pymodbustcp_client(our_port: int) -> Iterator[foreign.Program]:
    with foreign.python_peer("pymodbustcp_client.py", "127.0.0.1", our_port, UNIT) as program:
        yield program
