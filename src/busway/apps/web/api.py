"""The resources of the control API: what each asks of the simulation, and how that is shown.

Knows a simulation by `busway.apps.web.subject`; knows no socket and no page.

1. Whoever sets a point by the API is ``api`` to all who look at its last writer.
2. Many values are set one by one, in their order: what is refused keeps none of the others from being set, and is told.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any, Final, cast

from ...errors import ModbusError
from ...values.refusal import shown
from ...version import __version__
from ..control.plain import plain
from .faults import all_fault_profiles, all_faults, fault_named, put_on
from .messages import (
    Answer,
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
    plain_value,
)
from .operations import Operation, OperationCall, Problem
from .subject import Board, PageSubject, ServedUnits, ShownPoint
from .traffic import Traffic as TrafficTail

WHO: Final = "api"
_NO_POINT: Final = {HTTPStatus.NOT_FOUND: "There is no such unit or point."}
_NO_FAULT: Final = {HTTPStatus.NOT_FOUND: "There is no such fault."}
_POINT: Final = "/api/units/{unit}/points/{name}"
_RELEASE: Final = "/api/units/{unit}/release/{name}"
_FAULT: Final = "/api/faults/{name}"


@dataclass(slots=True)
class Api:
    """The resources of one simulation.

    Attributes:
        subject: the simulation.
        traffic: the frames that passed.
        name: what the simulation is called.
        order: its points in their order, as the stream numbers them.
        places: the number of each point by its key.
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
        """What answers by Modbus."""
        served = self.subject.server
        inner = getattr(served, "server", served)  # a service has its server as a part
        return cast("ServedUnits", inner)

    # What can be asked.

    def operations(self) -> list[Operation]:
        """All resources."""
        return [
            Operation(
                "GET", "/api/simulation", "get_simulation", "The simulation", SimulationAnswer, self.get_simulation
            ),
            Operation(
                "PATCH",
                "/api/simulation",
                "change_simulation",
                "Change the speed, pause it, let it go on",
                SimulationAnswer,
                self.change_simulation,
                body=SimulationChange,
            ),
            Operation("GET", "/api/units", "list_units", "The units", Units, self.list_units),
            Operation(
                "GET", "/api/points", "list_points", "Points", PointsMessage, self.list_points, query=PointsQuery
            ),
            Operation("GET", "/api/values", "get_values", "All values by key", Values, self.get_values),
            Operation("POST", "/api/values", "set_values", "Set many values", Written, self.set_values, body=NewValues),
            Operation(
                "GET", _POINT, "get_point", "A point", PointAnswer, self.get_point, rest="name", failures=_NO_POINT
            ),
            Operation(
                "PUT",
                _POINT,
                "set_point",
                "Set a value, against its behaviour",
                PointAnswer,
                self.set_point,
                body=NewValue,
                rest="name",
                failures=_NO_POINT,
            ),
            Operation(
                "POST",
                _RELEASE,
                "release_point",
                "Let a point follow its behaviour again",
                PointAnswer,
                self.release_point,
                rest="name",
                failures=_NO_POINT,
            ),
            Operation(
                "GET",
                "/api/faults",
                "list_faults",
                "Faults, and what can be put on",
                FaultsMessage,
                self.list_faults,
            ),
            Operation(
                "POST",
                "/api/faults",
                "add_fault",
                "Put a fault on",
                FaultAnswer,
                self.add_fault,
                body=NewFault,
                status=HTTPStatus.CREATED,
            ),
            Operation(
                "PATCH",
                _FAULT,
                "switch_fault",
                "Switch a fault on or off",
                FaultAnswer,
                self.switch_fault,
                body=Switch,
                rest="name",
                failures=_NO_FAULT,
            ),
            Operation(
                "DELETE",
                _FAULT,
                "remove_fault",
                "Take a fault off",
                Nothing,
                self.remove_fault,
                rest="name",
                failures=_NO_FAULT,
            ),
            Operation("GET", "/api/connections", "list_connections", "Connections", Connections, self.list_connections),
            Operation(
                "GET",
                "/api/lines",
                "list_lines",
                "Listeners and their status indicators",
                LinesMessage,
                self.list_lines,
            ),
            Operation("GET", "/api/counters", "get_counters", "Counters", CountersMessage, self.get_counters),
            Operation(
                "POST", "/api/counters/reset", "reset_counters", "Set them to zero", Nothing, self.reset_counters
            ),
            Operation(
                "GET",
                "/api/traffic",
                "list_traffic",
                "The last frames",
                TrafficMessage,
                self.list_traffic,
                query=TrafficQuery,
            ),
        ]

    # The simulation.

    async def get_simulation(self, call: OperationCall) -> Answer:
        """How it is."""
        return self.simulation()

    def simulation(self) -> SimulationAnswer:
        """How it is."""
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

    async def change_simulation(self, call: OperationCall) -> Answer:
        """Change speed and pause."""
        wanted: SimulationChange = call.body
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

    async def list_units(self, call: OperationCall) -> Answer:
        """The units."""
        return Units(
            units=[
                UnitAnswer(unit=number, name=unit.name, points=len(unit.points))
                for number, unit in self.subject.units.items()
            ]
        )

    async def list_points(self, call: OperationCall) -> Answer:
        """Points that fit the filters."""
        query: PointsQuery = call.query
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
        """A point by its number."""
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

    def _place(self, call: OperationCall) -> int:
        key = f"{call.path['unit']}/{call.path['name']}"
        place = self.places.get(key)
        if place is None:
            raise Problem(HTTPStatus.NOT_FOUND, f"there is no point {shown(key)}")
        return place

    async def get_point(self, call: OperationCall) -> Answer:
        """A point."""
        return self.shown(self._place(call))

    async def set_point(self, call: OperationCall) -> Answer:
        """Set it."""
        place = self._place(call)
        self.subject.set(self.order[place].key, given_value(call.body.value), WHO)
        return self.shown(place)

    async def release_point(self, call: OperationCall) -> Answer:
        """Let it go on."""
        place = self._place(call)
        self.subject.release(self.order[place].key)
        return self.shown(place)

    async def get_values(self, call: OperationCall) -> Answer:
        """All values."""
        return Values(values={point.key: plain_value(point.value) for point in self.order})

    async def set_values(self, call: OperationCall) -> Answer:
        """Set many."""
        refused: dict[str, str] = {}
        for key, value in call.body.values.items():
            if key not in self.places:
                refused[key] = f"there is no point {shown(key)}"
                continue
            try:
                self.subject.set(key, given_value(value), WHO)
            except ModbusError as error:
                refused[key] = error.message
        return Written(written=len(call.body.values) - len(refused), refused=refused)

    # Faults.

    @property
    def board(self) -> Board:
        """What goes wrong on purpose."""
        return self.subject.board

    def faults(self) -> list[FaultAnswer]:
        """All that were put on."""
        return all_faults(self.board)

    async def list_faults(self, call: OperationCall) -> Answer:
        """Faults and fault profiles."""
        return FaultsMessage(faults=self.faults(), fault_profiles=all_fault_profiles(self.board))

    async def add_fault(self, call: OperationCall) -> Answer:
        """Put one on."""
        return put_on(self.board, call.body)

    async def switch_fault(self, call: OperationCall) -> Answer:
        """Switch one."""
        name = self._fault(call)
        self.board.switch(name, on=call.body.on)
        return fault_named(self.board, name)

    async def remove_fault(self, call: OperationCall) -> Answer:
        """Take one off."""
        self.board.remove(self._fault(call))
        return Nothing()

    def _fault(self, call: OperationCall) -> str:
        name = call.path["name"]
        if not any(one.name == name for one in self.board.list()):
            raise Problem(HTTPStatus.NOT_FOUND, f"there is no fault {shown(name)}")
        return name

    # The server.

    async def list_connections(self, call: OperationCall) -> Answer:
        """Connections."""
        return Connections(connections=plain(self.server.status().connections))

    async def list_lines(self, call: OperationCall) -> Answer:
        """Listeners."""
        return LinesMessage(lines=plain(self.server.status().listeners))

    async def get_counters(self, call: OperationCall) -> Answer:
        """The counters."""
        return CountersMessage(counters=plain(self.server.status().counters))

    async def reset_counters(self, call: OperationCall) -> Answer:
        """Set them to zero."""
        self.server.reset_counters()
        return Nothing()

    def status(self) -> dict[str, Any]:  # Any: JSON
        """What the page shows of the server, once a second."""
        status = self.server.status()
        return {
            "time": time.time(),
            "simulation": self.simulation().model_dump(mode="json"),
            "connections": plain(status.connections),
            "counters": plain(status.counters),
            "lines": plain(status.listeners),
        }

    # Traffic.

    async def list_traffic(self, call: OperationCall) -> Answer:
        """Frames."""
        query: TrafficQuery = call.query
        tail = self.traffic
        after = 0 if query.after is None else query.after
        frames = [tail.shown(one) for one in tail.after(after, query.limit)]
        first = frames[0].number if frames else tail.last + 1
        return TrafficMessage(
            frames=frames, last=tail.last, lost=max(first - after - 1, 0) if query.after is not None else 0
        )
