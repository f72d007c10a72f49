"""A simulation with its control API, in a thread of its own: what the tests of the API and of the page look at."""

import asyncio
import contextlib
import http.client
import json
import threading
from collections.abc import AsyncIterator, Coroutine, Iterator
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

from busway.apps.simulator.includes import parse_declaration
from busway.apps.simulator.simulation import Simulation
from busway.apps.web.simulation_page import ControlPage

PLANT = """\
[[unit]]
unit = 1
name = "plant"

[[unit.point]]
name = "tank.level"
address = "3x1"
type = "float32"
unit_of_measure = "m"
description = "Level of the tank"
behaviour = { kind = "sine", mean = 2.0, amplitude = 0.5, period = 4, every = 0.1 }

[[unit.point]]
name = "tank.target"
address = "4x1"
type = "float32"
value = 2.0
unit_of_measure = "m"
minimum = 0
maximum = 4

[[unit.point]]
name = "pump.mode"
address = "4x3"
value = "off"
enumeration = { off = 0, manual = 1, auto = 2 }

[[unit.point]]
name = "pump.enabled"
address = "0x1"
value = true

[[unit.point]]
name = "meter.energy"
address = "4x10"
type = "uint64"
value = 9007199254740993

[[unit]]
unit = 2
name = "panel"

[[unit.point]]
name = "text/label"
address = "4x1"
type = "string:8"
value = "hello"
"""


@dataclass(slots=True)
class Watched:
    """What runs.

    Attributes:
        simulation: the plant.
        page: its API and page.
        endpoints: where it answers Modbus.
        loop: where it lives.
    """

    simulation: Simulation
    page: ControlPage
    endpoints: list[str] = field(default_factory=list)
    loop: asyncio.AbstractEventLoop | None = None

    def do(self, work: Coroutine[Any, Any, Any]) -> Any:
        """Do something in its event loop, from another thread."""
        assert self.loop is not None
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(20)

    @property
    def host(self) -> str:
        """Host and port of the page."""
        return urlsplit(self.page.url).netloc

    def ask(self, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, Any]:
        """Ask the API; status and content of the answer. Underscores in the names of headers are dashes."""
        status, content, _ = self.exchange(method, path, body, **headers)
        return status, json.loads(content)

    def exchange(self, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, bytes, dict[str, str]]:
        """The same, with the bytes and the headers of the answer; a body of bytes goes as it is."""
        data = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
        given = {"Content-Type": "application/json"} if data is not None else {}
        connection = http.client.HTTPConnection(self.host, timeout=60)
        try:
            given |= {name.replace("_", "-"): value for name, value in headers.items()}
            connection.request(method, path, data, given)
            answer = connection.getresponse()
            return answer.status, answer.read(), {name.lower(): value for name, value in answer.getheaders()}
        finally:
            connection.close()


@contextlib.asynccontextmanager
async def watching(text: str = PLANT, at: str = "127.0.0.1:0", *, token: str | None = None) -> AsyncIterator[Watched]:
    """A plant and its page, in the running event loop."""
    simulation = Simulation(parse_declaration(text, "plant.toml"))
    server = simulation.serve(["tcp://127.0.0.1:0"])
    page = ControlPage(simulation, at, token=token, name="plant")
    async with server, simulation.driven(server), page:
        yield Watched(simulation, page, list(server.endpoints), asyncio.get_running_loop())


@contextlib.contextmanager
def watched(text: str = PLANT, at: str = "127.0.0.1:0", *, token: str | None = None) -> Iterator[Watched]:
    """A plant and its page in a thread of their own, while the block runs."""
    ready: threading.Event = threading.Event()
    found: list[Watched] = []
    failures: list[BaseException] = []
    stop: list[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = []

    async def serve() -> None:
        ending = asyncio.Event()
        stop.append((asyncio.get_running_loop(), ending))
        async with watching(text, at, token=token) as one:
            found.append(one)
            ready.set()
            await ending.wait()

    def run() -> None:
        try:
            asyncio.run(serve())
        except BaseException as error:  # it is raised where the block ends
            failures.append(error)
        finally:
            ready.set()

    thread = threading.Thread(target=run, name="plant", daemon=True)
    thread.start()
    ready.wait(20)
    try:
        if failures:
            raise failures[0]
        yield found[0]
    finally:
        loop, ending = stop[0]
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(ending.set)
        thread.join(20)
    if failures:
        raise failures[0]
