"""The HTTP API of a simulation's page: points, faults, connections, traffic.

Knows a simulation by `busway.apps.web.simulation_subject`; knows no socket and no page.

1. A point that is set over the API has ``api`` as its last writer.
2. Many values are set one by one, in order: a refused value is reported and does not prevent the others.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Annotated, Any, Final, cast

from fastapi import Depends, FastAPI, Query
from starlette.exceptions import HTTPException

from ...errors import ModbusError
from ...values.unfit_values import shown
from ...version import __version__
from ..control.json_status import plain
from .messages import Failure, plain_value
from .request_guard import Role, require
from .simulation_faults import add_fault_to, all_fault_profiles, all_faults, fault_named
from .simulation_messages import (
    Connections,
    CountersMessage,
    FaultAnswer,
    FaultsMessage,
    LinesMessage,
    NewFault,
    NewValue,
    NewValues,
    Nothing,
    PointAnswer,
    PointsMessage,
    PointsQuery,
    SimulationAnswer,
    SimulationChange,
    Switch,
    TrafficMessage,
    TrafficQuery,
    UnitAnswer,
    Units,
    Values,
    Written,
    given_value,
)
from .simulation_subject import PageFaults, PageSubject, ServedUnits, ShownPoint
from .simulation_traffic import Traffic as TrafficTail

WHO: Final = "api"
_POINT: Final = "/api/units/{unit}/points/{name:path}"  # a name may hold slashes
_FAULT: Final = "/api/faults/{name:path}"
_Responses = dict[int | str, dict[str, Any]]  # Any: as FastAPI has them
_NO_POINT: Final[_Responses] = {404: {"model": Failure, "description": "There is no such unit or point."}}
_NO_FAULT: Final[_Responses] = {404: {"model": Failure, "description": "There is no such fault."}}


@dataclass(slots=True)
class Api:
    """The HTTP API of one simulation.

    Attributes:
        subject: the simulation.
        traffic: the latest Modbus frames of the simulation.
        name: name of the simulation.
        order: the points of the simulation, in the order of the file; the position of a point is its number in
            ``/stream``.
        places: by key of a point (``UNIT/NAME``), its position in ``order``.
    """

    subject: PageSubject
    traffic: TrafficTail
    name: str = "simulation"
    order: list[ShownPoint] = field(init=False)
    places: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        self.order = list(self.subject.points.values())
        self.places = {point.key: index for index, point in enumerate(self.order)}

    @property
    def server(self) -> ServedUnits:
        """The Modbus server of the simulation."""
        served = self.subject.server
        inner = getattr(served, "server", served)  # a service has its server as a part
        return cast("ServedUnits", inner)

    def add_to(self, application: FastAPI) -> None:
        """Add the routes of the API to a FastAPI application."""
        get, put, post, patch, delete = ([name] for name in ("GET", "PUT", "POST", "PATCH", "DELETE"))
        add = application.add_api_route
        operates = [Depends(require(Role.OPERATE))]
        add("/api/simulation", self.get_simulation, methods=get, summary="The simulation")
        add(
            "/api/simulation",
            self.change_simulation,
            methods=patch,
            dependencies=operates,
            summary="Change the speed, pause it, let it go on",
        )
        add("/api/units", self.list_units, methods=get, summary="The units")
        add("/api/points", self.list_points, methods=get, summary="Points")
        add("/api/values", self.get_values, methods=get, summary="All values by key")
        add("/api/values", self.set_values, methods=post, dependencies=operates, summary="Set many values")
        add(_POINT, self.get_point, methods=get, responses=_NO_POINT, summary="A point")
        add(
            _POINT,
            self.set_point,
            methods=put,
            dependencies=operates,
            responses=_NO_POINT,
            summary="Set a value, against its behaviour",
        )
        add(
            "/api/units/{unit}/release/{name:path}",
            self.release_point,
            methods=post,
            dependencies=operates,
            responses=_NO_POINT,
            summary="Let a point follow its behaviour again",
        )
        add("/api/faults", self.list_faults, methods=get, summary="Faults, and what can be put on")
        add(
            "/api/faults",
            self.add_fault,
            methods=post,
            dependencies=operates,
            status_code=201,
            summary="Put a fault on",
        )
        add(
            _FAULT,
            self.switch_fault,
            methods=patch,
            dependencies=operates,
            responses=_NO_FAULT,
            summary="Switch a fault on or off",
        )
        add(
            _FAULT,
            self.remove_fault,
            methods=delete,
            dependencies=operates,
            responses=_NO_FAULT,
            summary="Take a fault off",
        )
        add("/api/connections", self.list_connections, methods=get, summary="Connections")
        add("/api/lines", self.list_lines, methods=get, summary="Listeners and their status indicators")
        add("/api/counters", self.get_counters, methods=get, summary="Counters")
        add("/api/counters/reset", self.reset_counters, methods=post, dependencies=operates, summary="Set them to zero")
        add("/api/traffic", self.list_traffic, methods=get, summary="The last frames")

    # The simulation.

    async def get_simulation(self) -> SimulationAnswer:
        """Return name, size, simulated time and speed of the simulation."""
        return self.simulation()

    def simulation(self) -> SimulationAnswer:
        """Return name, size, simulated time and speed of the simulation, as for ``/api/simulation``."""
        subject = self.subject
        status = self.server.status()
        return SimulationAnswer(
            name=self.name,
            version=__version__,
            endpoints=list(status.endpoints),
            units=len(subject.units),
            points=len(self.order),
            uptime=status.uptime,
            time=subject.time,
            seed=subject.seed,
            speed=subject.speed,
            paused=subject.is_paused,
        )

    async def change_simulation(self, wanted: SimulationChange) -> SimulationAnswer:
        """Change the speed of the simulation, pause or resume it. Returns its state after that."""
        subject = self.subject
        if wanted.speed is not None:
            subject.change_speed(wanted.speed)
        if wanted.paused is not None and wanted.paused != subject.is_paused:
            if wanted.paused:
                subject.pause()
            else:
                subject.resume()
        return self.simulation()

    # Units and points.

    async def list_units(self) -> Units:
        """Return all units of the simulation, each with the number of its points."""
        return Units(
            units=[
                UnitAnswer(unit=number, name=unit.name, points=len(unit.points))
                for number, unit in self.subject.units.items()
            ]
        )

    async def list_points(self, query: Annotated[PointsQuery, Query()]) -> PointsMessage:
        """Return the points of the simulation that match the filters, from ``skip`` on, and the number of matches."""
        found = list(self._chosen(query))
        return PointsMessage(
            points=[self.shown(index) for index in found[query.skip : query.skip + query.limit]], total=len(found)
        )

    def _chosen(self, query: PointsQuery) -> Iterator[int]:
        wanted = (query.search or "").casefold()
        for index, point in enumerate(self.order):
            if query.unit is not None and point.unit != query.unit:
                continue
            texts = (point.key, point.description, point.unit_of_measure, point.notation)
            if not wanted or any(wanted in text.casefold() for text in texts):
                yield index

    def shown(self, index: int) -> PointAnswer:
        """Return the description and the value of the point at a position in ``order``."""
        point = self.order[index]
        return PointAnswer(
            index=index,
            key=point.key,
            unit=point.unit,
            name=point.name,
            table=point.table.value,
            address=point.notation,
            type=point.type,
            order=point.order,
            scale=point.scale,
            unit_of_measure=point.unit_of_measure,
            description=point.description,
            access=point.access,
            minimum=point.minimum,
            maximum=point.maximum,
            enumeration=dict(point.enumeration),
            behaviour=point.behaviour,
            value=plain_value(point.value),
            raw=point.raw,
            held=point.is_held,
            changed_at=point.changed_at,
            last_writer=point.last_writer,
        )

    def _place(self, unit: str, name: str) -> int:
        key = f"{unit}/{name}"
        place = self.places.get(key)
        if place is None:
            raise HTTPException(HTTPStatus.NOT_FOUND, f"there is no point {shown(key)}")
        return place

    async def get_point(self, unit: str, name: str) -> PointAnswer:
        """Return one point of the simulation and its value."""
        return self.shown(self._place(unit, name))

    async def set_point(self, unit: str, name: str, new: NewValue) -> PointAnswer:
        """Set the value of a point, which keeps it until it is released or `resume_after` ends. Returns the point."""
        place = self._place(unit, name)
        self.subject.set(self.order[place].key, given_value(new.value), WHO)
        return self.shown(place)

    async def release_point(self, unit: str, name: str) -> PointAnswer:
        """Let a point that was set follow its behaviour again. Returns the point."""
        place = self._place(unit, name)
        self.subject.release(self.order[place].key)
        return self.shown(place)

    async def get_values(self) -> Values:
        """Return the values of all points of the simulation, by key (``UNIT/NAME``)."""
        return Values(values={point.key: plain_value(point.value) for point in self.order})

    async def set_values(self, new: NewValues) -> Written:
        """Set the values of many points. A refused value, returned with the reason, does not prevent the others."""
        refused: dict[str, str] = {}
        for key, value in new.values.items():
            if key not in self.places:
                refused[key] = f"there is no point {shown(key)}"
                continue
            try:
                self.subject.set(key, given_value(value), WHO)
            except ModbusError as error:
                refused[key] = error.message
        return Written(written=len(new.values) - len(refused), refused=refused)

    # Faults.

    @property
    def switchboard(self) -> PageFaults:
        """The faults of the simulation, which can be added, switched and removed."""
        return self.subject.switchboard

    def faults(self) -> list[FaultAnswer]:
        """Return all faults that were added to the simulation, in the order in which they are applied."""
        return all_faults(self.switchboard)

    async def list_faults(self) -> FaultsMessage:
        """Return the faults that were added to the simulation, and the fault profiles of which faults can be added."""
        return FaultsMessage(faults=self.faults(), fault_profiles=all_fault_profiles(self.switchboard))

    async def add_fault(self, new: NewFault) -> FaultAnswer:
        """Add a fault to the simulated devices, and return it."""
        return add_fault_to(self.switchboard, new)

    async def switch_fault(self, name: str, switch: Switch) -> FaultAnswer:
        """Switch a fault of the simulated devices on or off, and return it."""
        self.switchboard.switch(self._fault(name), on=switch.on)
        return fault_named(self.switchboard, name)

    async def remove_fault(self, name: str) -> Nothing:
        """Remove a fault of the simulated devices."""
        self.switchboard.remove(self._fault(name))
        return Nothing()

    def _fault(self, name: str) -> str:
        if not any(one.name == name for one in self.switchboard.list()):
            raise HTTPException(HTTPStatus.NOT_FOUND, f"there is no fault {shown(name)}")
        return name

    # The server.

    async def list_connections(self) -> Connections:
        """Return the open Modbus connections to the simulation, the oldest first."""
        return Connections(connections=plain(self.server.status().connections))

    async def list_lines(self) -> LinesMessage:
        """Return the listeners of the simulation with their status indicators."""
        return LinesMessage(lines=plain(self.server.status().listeners))

    async def get_counters(self) -> CountersMessage:
        """Return the counters of the simulation's Modbus server, since its start or the last reset."""
        return CountersMessage(counters=plain(self.server.status().counters))

    async def reset_counters(self) -> Nothing:
        """Set the counters of the simulation's Modbus server to zero."""
        self.server.reset_counters()
        return Nothing()

    def status(self) -> dict[str, Any]:  # Any: JSON
        """Return the state of server and simulation as JSON; ``/stream`` sends it to each open page once a second."""
        status = self.server.status()
        return {
            "time": time.time(),
            "simulation": self.simulation().model_dump(mode="json"),
            "connections": plain(status.connections),
            "counters": plain(status.counters),
            "lines": plain(status.listeners),
        }

    # Traffic.

    async def list_traffic(self, query: Annotated[TrafficQuery, Query()]) -> TrafficMessage:
        """Return the latest Modbus frames, or the latest after a number; and how many after it are kept no longer."""
        tail = self.traffic
        after = 0 if query.after is None else query.after
        last = tail.last  # before the frames are read: what another thread adds meanwhile comes next time
        frames = [tail.shown(one) for one in tail.after(after, query.limit)]
        lost = 0 if query.after is None else max(tail.first - after - 1, 0)
        return TrafficMessage(frames=frames, last=frames[-1].number if frames else last, lost=lost)
