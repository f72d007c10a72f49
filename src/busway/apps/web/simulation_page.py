"""The web page of a simulation: its module, and the page that shows it.

Knows a simulation by `busway.apps.web.simulation_subject`.
"""

import contextlib
from collections.abc import Iterator
from typing import Final

from fastapi import FastAPI
from starlette.routing import WebSocketRoute

from ...options.endpoints import parse_endpoint
from .application import PageModule
from .hosting import HostedPage
from .simulation_api import Api
from .simulation_stream import Streams
from .simulation_subject import PageSubject
from .simulation_traffic import Traffic

DEFAULT_ADDRESS: Final = "127.0.0.1:8502"


class ControlPage(HostedPage):
    """The web page of a simulation with its API; it is served while the ``async with`` block lasts::

        async with ControlPage(simulation) as page:
            print(page.url)

    Args:
        subject: the running simulation.
        at: host and port to listen on; port 0 takes a free port.
        token: token that every request to the API must carry. None: no token is needed on a loopback address, and a new
            token is created on other addresses.
        name: name of the simulation, which the page shows.

    Attributes:
        traffic: the latest Modbus frames of the simulation; recorded while the page is served.
        title, description: title and description of the OpenAPI document.
        name: name of the page's module.
        api: the HTTP API of the simulation.
        streams: the WebSockets of the open pages.

    Raises:
        ConfigError: the address or the token is invalid. Raised by `start`: traffic is recorded already.
    """

    title = "busway simulator"
    description = (
        "Values, faults and traffic of a simulated plant. The WebSocket /stream reports events as they happen."
    )
    name = "simulation"

    def __init__(
        self,
        subject: PageSubject,
        at: str = DEFAULT_ADDRESS,
        *,
        token: str | None = None,
        name: str = "simulation",
    ) -> None:
        super().__init__(at, token=token)
        self.traffic: Traffic = Traffic(self._ports)
        self.api: Api = Api(subject, self.traffic, name)
        self.streams: Streams = Streams(self.api)

    @contextlib.contextmanager
    def _lasting(self) -> Iterator[None]:
        self.traffic.start()
        try:
            yield
        finally:
            self.traffic.stop()

    def modules(self) -> list[PageModule]:
        """Return the module that the page shows: the simulation."""
        return [self]

    def add_to(self, application: FastAPI) -> None:
        """Add the routes of the simulation and the WebSocket ``/stream`` to a FastAPI application."""
        self.api.add_to(application)
        application.routes.append(WebSocketRoute("/stream", self.streams.serve))

    def _ports(self) -> set[int]:
        endpoints = [parse_endpoint(url) for url in self.api.server.endpoints]
        return {one.port for one in endpoints if one.port is not None}
