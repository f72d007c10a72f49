"""The faults of a server by name: a file, a command line or the web page adds, switches and removes them.

Knows fault profiles, names and the server's side of faults; knows no file and no HTTP.

::

    switchboard = FaultSwitchboard(seed=7)
    switchboard.add("late", units={3}, parameters={"delay": 2.0})
    switchboard.attach(server)
    switchboard.switch("late", on=False)

1. A switchboard serves one server: its faults apply to the connections of that server.
2. All methods may be called from any thread. Changes apply from the next request on.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ..codes import Table
from ..server.server import Server
from ..session.responder import Responder
from .applied_faults import AppliedFault, Faults, Schedule, Selection
from .clock import Clock
from .fault import EVERYWHERE, Carrier
from .faulty_connections import FaultyTap
from .faulty_responder import FaultyResponder
from .profile import FaultProfileTable
from .profiles import FAULT_PROFILES


@dataclass(frozen=True, slots=True)
class FaultStatus:
    """The status of one fault when it was asked for: its profile, parameters, whether it is on, how often it applied.

    Attributes:
        name: the name of the fault.
        fault_profile: the name of its fault profile.
        happens: what the faulty device does, in words; empty if the fault profile is not in the table.
        is_on: whether it is switched on, whatever its schedule.
        struck: number of requests it has changed and of connections it has refused or closed.
        parameters: all parameters of the fault profile, with their values.
        selection: which requests it applies to.
        carriers: the kinds of transport on which it can occur.
    """

    name: str
    fault_profile: str
    happens: str
    is_on: bool
    struck: int
    parameters: Mapping[str, Any]  # of the types that the fault profile declares
    selection: Selection
    carriers: frozenset[Carrier] = EVERYWHERE


class FaultSwitchboard:
    """The faults of one server, which can be added, switched and removed by name.

    Args:
        seed: seed of random choices: with an equal seed, and equal faults added in the same order, an equal sequence of
            requests meets the same faults.
        clock: clock of delays and schedules; None for the clock of the event loop.
        fault_profiles: the fault profiles to choose from.

    Attributes:
        faults: the faults as objects.
        tap: the connection tap that carries the faults out; it has to be the ``tap`` of the server.
        fault_profiles: the fault profiles from which `add` chooses.
    """

    def __init__(
        self, *, seed: int = 0, clock: Clock | None = None, fault_profiles: FaultProfileTable = FAULT_PROFILES
    ) -> None:
        self.faults: Faults = Faults(seed)
        self.tap: FaultyTap = FaultyTap(self.faults, clock)
        self.fault_profiles = fault_profiles

    def attach(self, server: Server) -> None:
        """Apply these faults on all listeners of a server. Raises `ConfigError` if the server is running."""
        server.wrap_responder(self.around)
        server.use_tap(self.tap)

    def around(self, responder: Responder) -> FaultyResponder:
        """Return a responder that applies these faults to the replies of ``responder``.

        The server that uses it must also use ``tap`` of this switchboard; `attach` arranges both.
        """
        return FaultyResponder(responder, self.faults, self.tap)

    def add(
        self,
        fault_profile: str,
        *,
        name: str = "",
        units: Collection[int] | None = None,
        functions: Collection[int] | None = None,
        addresses: range | None = None,
        items: Mapping[Table, Collection[tuple[int, int]]] | None = None,
        probability: float = 1.0,
        schedule: Schedule | None = None,
        on: bool = True,
        parameters: Mapping[str, Any] | None = None,  # as `FaultStatus.parameters`
    ) -> str:
        """Create a fault from a fault profile and add it to the server; it acts after the existing faults.

        Args:
            fault_profile: the name of a fault profile.
            name: name of the fault; by default that of its profile, with a number if it is taken.
            units: unit identifiers of the requests that it applies to, 0…255; None for all.
            functions: function codes of those requests, 1…127; None for all.
            addresses: range of items, 0-based, in every table: requests that read or write one of them. None for all.
            items: items by table, as ranges: the first item, 0-based, and the one after the last; requests that read or
                write one of them. None for all.
            probability: share of the requests fitting all these arguments that it changes, 0…1; chosen at random.
            schedule: when it is active; None for always.
            on: whether it is switched on.
            parameters: values for the parameters of the fault profile; the others have their defaults.

        Returns:
            The name of the fault.

        Raises:
            ConfigError: a name is unknown or taken, or an argument is invalid; ``key`` of the error says which.
        """
        fault = self.fault_profiles.named(fault_profile)(**(parameters or {}))
        selection = Selection(units, functions, addresses, probability, schedule or Schedule(), items)
        return self.faults.add(fault, selection, enabled=on, label=name).label

    def switch(self, name: str, *, on: bool) -> None:
        """Switch a fault on or off. Switching on a fault that is on does not restart its schedule.

        Raises:
            ConfigError: there is no fault with this name.
        """
        applied = self.faults.find(name)
        if on != applied.enabled:
            applied.on() if on else applied.off()

    def remove(self, name: str) -> None:
        """Remove a fault from the server. Raises `ConfigError` for an unknown name."""
        self.faults.remove(self.faults.find(name))

    def list(self) -> list[FaultStatus]:
        """Return the status of all faults, in the order in which they act."""
        return [self._status(one) for one in self.faults]

    def __iter__(self) -> Iterator[FaultStatus]:
        return iter(self.list())

    def status(self, name: str) -> FaultStatus:
        """Return the status of one fault. Raises `ConfigError` for an unknown name."""
        return self._status(self.faults.find(name))

    def watch(self, changed: Callable[[], None]) -> Callable[[], None]:
        """Register a function that is called after a fault was added, removed or switched.

        The call is made without arguments, in the thread that made the change.

        Returns:
            A function that unregisters ``changed``.
        """
        self.faults.watch(changed)
        return lambda: self.faults.unwatch(changed)

    def _status(self, applied: AppliedFault) -> FaultStatus:
        fault = applied.fault
        known = self.fault_profiles.get(fault.name)
        return FaultStatus(
            name=applied.label,
            fault_profile=fault.name,
            happens="" if known is None else known.happens,
            is_on=applied.enabled,
            struck=applied.struck,
            parameters={**({} if known is None else known.options), **fault.options},
            selection=applied.selection,
            carriers=fault.carriers,
        )
