"""Faults by name: what somebody switches who does not hold the objects, from a file, a command line, a page.

Knows fault profiles, names and the server's side of faults; knows no file and no HTTP.

::

    board = FaultSwitchboard(seed=7)
    board.add("late", units={3}, parameters={"delay": 2.0})
    board.attach(server)
    board.switch("late", on=False)

1. A board serves one server: faults and ways belong together.
2. Everything may be called from any thread. What is changed holds from the next request on.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ..codes import Table
from ..server.server import Server
from ..session.handler import Handler
from .clock import Clock
from .connections import FaultyTap
from .fault import AppliedFault, Faults, Schedule, Selection
from .profile import FaultyTable
from .profiles import FAULT_PROFILES
from .responder import FaultyHandler


@dataclass(frozen=True, slots=True)
class FaultStatus:
    """A fault as it stands.

    Attributes:
        name: what it is called.
        personality: what it is.
        happens: what happens, in words.
        is_on: the switch.
        struck: requests that it has struck, connections that it has refused or closed.
        parameters: all of the fault profile, as they hold.
        selection: which requests it is for.
    """

    name: str
    personality: str
    happens: str
    is_on: bool
    struck: int
    parameters: Mapping[str, Any]  # of the types that the fault profile declares
    selection: Selection


class FaultSwitchboard:
    """The faults of one server.

    Args:
        seed: what chance is made from: the same seed and the same requests meet the same faults.
        clock: what delays and schedules are measured by; the event loop's by default.
        personalities: what there is to choose from.

    Attributes:
        faults: the faults themselves.
        tap: to be given to the server.
        personalities: as given.
    """

    def __init__(
        self, *, seed: int = 0, clock: Clock | None = None, personalities: FaultyTable = FAULT_PROFILES
    ) -> None:
        self.faults = Faults(seed)
        self.tap = FaultyTap(self.faults, clock)
        self.personalities = personalities

    def attach(self, server: Server) -> None:
        """Let a server play the faults, on all its listeners. Raises `ConfigError` while it is running."""
        server.wrap_handler(self.around)
        server.use_tap(self.tap)

    def around(self, handler: Handler) -> FaultyHandler:
        """A handler that plays the faults on what ``handler`` answers; its server needs ``tap`` too."""
        return FaultyHandler(handler, self.faults, self.tap)

    def add(
        self,
        personality: str,
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
        """Put a fault on, behind the others.

        Args:
            personality: its name.
            name: what to call it; by default as its fault profile, with a number where that is taken.
            units: unit identifiers that it strikes, 0…255; None for all, here and below.
            functions: function codes, 1…127.
            addresses: items of any table, 0-based; requests that touch one of them.
            items: the same by table, as ranges of the first item and the one behind the last.
            probability: 0…1, the part of those requests that it strikes.
            schedule: when.
            on: whether it is switched on.
            parameters: of the fault profile.

        Returns:
            Its name.

        Raises:
            ConfigError: a name is unknown or taken, a parameter or a choice cannot be; its key says which.
        """
        fault = self.personalities.named(personality)(**(parameters or {}))
        selection = Selection(units, functions, addresses, probability, schedule or Schedule(), items)
        return self.faults.add(fault, selection, enabled=on, label=name).label

    def switch(self, name: str, *, on: bool) -> None:
        """Switch a fault; where it was on already, its schedule goes on. Raises `ConfigError` for an unknown name."""
        applied = self.faults.find(name)
        if on != applied.enabled:
            applied.on() if on else applied.off()

    def remove(self, name: str) -> None:
        """Take a fault off. Raises `ConfigError` for an unknown name."""
        self.faults.remove(self.faults.find(name))

    def list(self) -> list[FaultStatus]:
        """All faults, in the order in which they act."""
        return [self._status(one) for one in self.faults]

    def __iter__(self) -> Iterator[FaultStatus]:
        return iter(self.list())

    def status(self, name: str) -> FaultStatus:
        """One fault. Raises `ConfigError` for an unknown name."""
        return self._status(self.faults.find(name))

    def watch(self, changed: Callable[[], None]) -> Callable[[], None]:
        """Have ``changed`` called, in whatever thread, after faults were put on, taken off or switched.

        Returns:
            What ends that when it is called.
        """
        self.faults.watch(changed)
        return lambda: self.faults.unwatch(changed)

    def _status(self, applied: AppliedFault) -> FaultStatus:
        fault = applied.fault
        known = self.personalities.get(fault.name)
        return FaultStatus(
            name=applied.label,
            personality=fault.name,
            happens="" if known is None else known.happens,
            is_on=applied.enabled,
            struck=applied.struck,
            parameters={**({} if known is None else known.options), **fault.options},
            selection=applied.selection,
        )
