"""The interface of a simulation that the API needs.

Knows the shape of a simulation; knows no implementation. `busway.apps.simulator.simulation` has it.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol

from ...codes import Table
from ...faults.fault import Schedule
from ...faults.profile import FaultProfileTable
from ...server.status import ServerStatus


class ShownPoint(Protocol):
    """A named value of a unit; `busway.apps.simulator.simulated.SimulatedPoint` says what each of these is."""

    @property
    def key(self) -> str: ...
    @property
    def unit(self) -> int: ...
    @property
    def name(self) -> str: ...
    @property
    def table(self) -> Table: ...
    @property
    def notation(self) -> str: ...
    @property
    def type(self) -> str: ...
    @property
    def order(self) -> str: ...
    @property
    def scale(self) -> float: ...
    @property
    def unit_of_measure(self) -> str: ...
    @property
    def description(self) -> str: ...
    @property
    def access(self) -> str: ...
    @property
    def minimum(self) -> float | None: ...
    @property
    def maximum(self) -> float | None: ...
    @property
    def enumeration(self) -> Mapping[str, int]: ...
    @property
    def behaviour(self) -> str: ...
    @property
    def is_held(self) -> bool: ...
    @property
    def value(self) -> Any: ...  # Any: what the point's type says
    @property
    def raw(self) -> str: ...
    @property
    def changed_at(self) -> float: ...
    @property
    def last_writer(self) -> str: ...


class PageUnit(Protocol):
    """A simulated device."""

    @property
    def unit(self) -> int: ...
    @property
    def name(self) -> str: ...
    @property
    def points(self) -> Mapping[str, Any]: ...  # Any: not looked at, only counted


class PointChange(Protocol):
    """A new value of a point."""

    @property
    def key(self) -> str:
        """``UNIT/NAME``."""


class ServedUnits(Protocol):
    """The server in front of the units."""

    @property
    def endpoints(self) -> list[str]:
        """URLs as they are bound."""

    def status(self) -> ServerStatus:
        """Present state: listeners, connections, counters."""

    def reset_counters(self) -> None:
        """Set the counters to zero."""


Watcher = Callable[[Sequence[Any]], None]  # Any: `PointChange`


class Board(Protocol):
    """Faults by name; `busway.faults.switchboard.FaultSwitchboard` says what each of these does."""

    @property
    def fault_profiles(self) -> FaultProfileTable: ...

    def add(
        self,
        fault_profile: str,
        *,
        name: str = "",
        units: Collection[int] | None = None,
        functions: Collection[int] | None = None,
        addresses: range | None = None,
        probability: float = 1.0,
        schedule: Schedule | None = None,
        on: bool = True,
        parameters: Mapping[str, Any] | None = None,  # Any: as the fault profile declares them
    ) -> str: ...

    def switch(self, name: str, *, on: bool) -> None: ...

    def remove(self, name: str) -> None: ...

    def list(self) -> Sequence[Any]: ...  # Any: `FaultStatus`

    def status(self, name: str) -> Any: ...

    def watch(self, changed: Callable[[], None]) -> Callable[[], None]: ...


class PageSubject(Protocol):
    """A simulation."""

    @property
    def units(self) -> Mapping[int, PageUnit]:
        """The units by number."""

    @property
    def points(self) -> Mapping[str, Any]:  # Any: `ShownPoint`
        """The points by key."""

    @property
    def server(self) -> ServedUnits:
        """The Modbus server."""

    @property
    def board(self) -> Board:
        """The switchboard of faults."""

    def set(self, key: str, value: Any, who: str) -> Any:  # Any: what the point's type says
        """Set a point; the value holds against its behaviour until `release`. Raises `InvalidRequest`."""

    def release(self, key: str) -> Any:
        """Let the behaviour of a point continue."""

    def watch(self, callback: Watcher) -> Any:
        """Call ``callback`` with each group of changes. Returns a function that ends it."""

    # Time.

    seed: int
    speed: float
    is_paused: bool

    @property
    def time(self) -> float:
        """Seconds since the simulation began."""

    def change_speed(self, speed: float) -> None:
        """Set the seconds of the simulation per second."""

    def pause(self) -> None:
        """Stop the time of the simulation."""

    def resume(self) -> None:
        """Let the time of the simulation continue."""
