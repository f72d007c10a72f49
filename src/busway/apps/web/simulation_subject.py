"""The interface of a simulation, as its page and HTTP API use it.

Knows nothing but the interface; `busway.apps.simulator.simulation` implements it.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol

from ...codes import Table
from ...faults.applied_faults import Schedule
from ...faults.profile import FaultProfileTable
from ...server.status import ServerStatus


class ShownPoint(Protocol):
    """Interface of a simulated point as the page shows it; `SimulatedPoint` documents each attribute."""

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
    """Interface of a simulated device as the page shows it: unit number, name, and points by name."""

    @property
    def unit(self) -> int: ...
    @property
    def name(self) -> str: ...
    @property
    def points(self) -> Mapping[str, Any]: ...  # Any: not looked at, only counted


class PointChange(Protocol):
    """Interface of a change of a simulated point's value."""

    @property
    def key(self) -> str:
        """Key of the changed point: ``UNIT/NAME``."""


class ServedUnits(Protocol):
    """Interface of the Modbus server that serves the simulated devices."""

    @property
    def endpoints(self) -> list[str]:
        """URLs of the server's listeners, with the ports that they are bound to."""

    def status(self) -> ServerStatus:
        """Return the state of the server: listeners, connections, counters."""

    def reset_counters(self) -> None:
        """Set the counters of the server to zero."""


PageObserver = Callable[[Sequence[Any]], None]  # Any: `PointChange`


class PageFaults(Protocol):
    """Interface of the faults of a simulation by name; `FaultSwitchboard` documents each method."""

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
    """Interface of a simulation: what its web page shows and changes."""

    @property
    def units(self) -> Mapping[int, PageUnit]:
        """The simulated devices, by unit number."""

    @property
    def points(self) -> Mapping[str, Any]:  # Any: `ShownPoint`
        """The simulated points (`ShownPoint`), by key (``UNIT/NAME``)."""

    @property
    def server(self) -> ServedUnits:
        """The Modbus server of the simulation."""

    @property
    def switchboard(self) -> PageFaults:
        """The faults of the simulation."""

    def set(self, key: str, value: Any, who: str) -> Any:  # Any: what the point's type says
        """Set the value of a point, which keeps it until `release` or for its behaviour's ``resume_after`` seconds.

        Args:
            key: key of the point: ``UNIT/NAME``.
            value: the value, in the unit of measure.
            who: name recorded as the point's last writer.

        Raises:
            InvalidRequest: there is no such point, or it cannot have this value.
        """

    def release(self, key: str) -> Any:
        """Let a point that was set follow its behaviour again. ``key`` is ``UNIT/NAME``.

        Raises:
            InvalidRequest: there is no such point.
        """

    def watch(self, callback: PageObserver) -> Any:
        """Register a function called with each list of `PointChange`s; returns a function that unregisters it."""

    # Time.

    seed: int
    speed: float
    is_paused: bool

    @property
    def time(self) -> float:
        """Seconds of simulated time since the simulation began."""

    def change_speed(self, speed: float) -> None:
        """Set how many simulated seconds pass in one second of the clock. Call this in the thread of the event loop.

        Raises:
            ConfigError: the speed is not above 0, or infinite.
        """

    def pause(self) -> None:
        """Stop the simulated time; points can still be set."""

    def resume(self) -> None:
        """Let the simulated time continue from where `pause` stopped it."""
