"""A running simulation: units whose points follow their behaviours, and can be set by people and programs.

Knows files of simulations, the engine and a clock; knows no page. The fault switchboard applies faults to requests.

>>> simulation = Simulation("plant.toml")                                    # doctest: +SKIP
>>> async with simulation.running("tcp://127.0.0.1:5020"): ...               # doctest: +SKIP

1. Values are functions of the simulation's time, which begins at 0 and goes on where it stopped if values are kept.
   The same file, seed and times give the same values.
2. Without a clock nothing happens by itself: the program calls `tick` with the time.
3. A point that was set by hand, or written by Modbus, does not follow its behaviour until it is released, by
   `release` or after the ``resume_after`` seconds of its behaviour.
4. A program that cannot keep up leaves moments out, so that it does not fall behind more and more.
"""

import asyncio
import logging
import math
import os
import threading
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Protocol, Self

from ...access.rules import AccessRules, Policy
from ...config.files.simulation import SimulationFile
from ...errors import ConfigError, InvalidRequest
from ...faults.switchboard import FaultSwitchboard
from ...pdu.functions import STANDARD, FunctionTable
from ...server.listener import Listener
from ...session.server_pipeline import RequestObserver
from ...values.unfit_values import shown
from .added_faults import put_on
from .builder import build_simulation
from .engine import Engine
from .includes import SimulationDeclaration, load_declaration
from .kept_values import KeptValues
from .simulated import SIMULATION, PointChanged, SimulatedPoint, SimulatedUnit
from .write_watch import watch_writes

if TYPE_CHECKING:
    from ...faults.applied_faults import Faults
    from ...server.server import Server

_log = logging.getLogger("busway.apps.simulator")

SLICE: Final = 0.002
"""Seconds for which the engine computes values in one go; then requests are answered before it goes on."""

PointsObserver = Callable[[list[PointChanged]], object]


class SimulationTimer(Protocol):
    """Interface of a call scheduled with the simulation's clock."""

    def cancel(self) -> None:
        """Cancel the scheduled call: the function is not called any more."""


class SimulationClock(Protocol):
    """Interface of a clock that also calls functions at given times, as `busway.testing.FakeClock` does."""

    def now(self) -> float:
        """Return the current time of the clock in seconds, monotonic."""

    def call_at(self, when: float, callback: Callable[[], object]) -> SimulationTimer:
        """Schedule one call of ``callback``, when ``now()`` has reached ``when`` (seconds); return its timer."""


class _LoopClock:
    """The clock of the running event loop, used by simulations in real time."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self.now = self._loop.time
        self.call_at = self._loop.call_at


class Simulation:
    """Simulated units from a file, whose points follow their behaviours.

    Args:
        file: path of a simulation file; or the result of `busway.apps.simulator.includes.parse_declaration`.
        clock: the clock. None: the clock of the event loop while `running` or `driven` lasts, and no clock otherwise.
        seed: seed of all random numbers; None to use the file's, which is 0 by default.
        speed: seconds of the simulation in one second of the clock, above 0.

    Raises:
        ConfigError: a file cannot be read or is invalid; then the error has all ``problems``, each with file, line and
            key.

    Attributes:
        declaration: the simulation file with all its includes.
        seed: seed of all random numbers.
        units: the units by number.
        points: all points by ``UNIT/NAME``.
        switchboard: the faults by name, to add, switch and remove them; every server that `serve` creates applies them.
        speed: seconds of the simulation in one second of the clock.
        is_paused: whether the simulated time stands still.
        warnings: a sentence for each saved value that could not be restored.
    """

    def __init__(
        self,
        file: str | os.PathLike[str] | SimulationDeclaration,
        *,
        clock: SimulationClock | None = None,
        seed: int | None = None,
        speed: float = 1.0,
    ) -> None:
        _check_speed(speed)
        self.declaration: SimulationDeclaration = (
            file if isinstance(file, SimulationDeclaration) else load_declaration(file)
        )
        settings = self.declaration.file.simulation
        self.seed: int = settings.seed if seed is None else seed
        self.speed: float = speed
        self.is_paused: bool = False
        built = build_simulation(self.declaration.units, self.seed)
        self.units: Mapping[int, SimulatedUnit] = MappingProxyType(built.units)
        self.points: Mapping[str, SimulatedPoint] = MappingProxyType(built.points)
        self.switchboard: FaultSwitchboard = FaultSwitchboard(seed=self.seed, clock=clock)
        put_on(self.switchboard, self.declaration.file.fault)
        self._watchers: tuple[PointsObserver, ...] = ()
        self._observers: list[RequestObserver] = []
        self._server: Server | None = None
        self._clock = clock
        self._time = 0.0
        self._origin: tuple[float, float] | None = None if clock is None else (clock.now(), 0.0)
        self._timer: SimulationTimer | None = None
        self._thread: int | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._engine = Engine(built.driven, self._followed)
        self._kept = KeptValues(self.declaration.state, self.points, self._engine)
        self.warnings: list[str] = self._kept.warnings
        self._time = self._kept.begin()
        if self._origin is not None:
            self._origin = (self._origin[0], self._time)
        for unit in self.units.values():
            watch_writes(unit.device, list(unit.points.values()), self._written)

    # ---- points

    @property
    def time(self) -> float:
        """The current time of the simulation, in seconds since its beginning; without a clock that of the last tick."""
        return self._time if self._clock is None else self._time_at(self._clock.now())

    @property
    def changes(self) -> int:
        """The number of new values that behaviours have given to points so far."""
        return self._engine.changes

    @property
    def left_out(self) -> int:
        """The number of moments at which points did not get their values because the program was too slow.

        Each group of points that change together counts for itself.
        """
        return self._engine.left_out

    def point(self, key: str) -> SimulatedPoint:
        """Return the point with a key ``UNIT/NAME``. Raises `InvalidRequest` if there is none."""
        point = self.points.get(key)
        if point is None:
            raise InvalidRequest(f"there is no point {shown(key)}; a point is UNIT/NAME")
        return point

    def set(self, key: str, value: Any, who: str = "api") -> None:  # Any: what the point's type says
        """Set a point by hand: it keeps the value until `release`, or for its behaviour's ``resume_after`` seconds.

        May be called in any thread. Points that Modbus clients may only read can be set, too.

        Args:
            key: ``UNIT/NAME``.
            value: the value in the unit of measure, or its name in the point's enumeration.
            who: name of the writer, for `SimulatedPoint.last_writer` and the functions of `watch`.

        Raises:
            InvalidRequest: there is no such point, or the value does not fit its type or range, or is no name of a
                value.
        """
        point = self.point(key)
        with point.device.lock:
            point.put(value)
            changes = self._held([point], who)
        self._notify(changes)

    def release(self, key: str) -> None:
        """Let a point that was set by hand or by Modbus follow its behaviour again, from its next moment on.

        Does nothing for a point that was not set, or has no behaviour. May be called in any thread.

        Raises:
            InvalidRequest: there is no such point.
        """
        point = self.point(key)
        with point.device.lock:
            self._engine.release(point, self.time)

    def watch(self, callback: PointsObserver) -> Callable[[], None]:
        """Register a function to be called with each group of new values.

        Args:
            callback: called with the list of changes (`PointChanged`), in the thread that made them; its errors are
                logged.

        Returns:
            A function that unregisters ``callback``.
        """
        self._watchers = (*self._watchers, callback)

        def end() -> None:
            self._watchers = tuple(each for each in self._watchers if each is not callback)

        return end

    @property
    def faults(self) -> "Faults":
        """The faults that servers apply to requests for the simulated devices; `switchboard` finds them by name."""
        return self.switchboard.faults

    # ---- time

    def tick(self, now: float) -> None:
        """Compute the values of all points at each moment up to a time; no moment is left out.

        Args:
            now: the time of the clock in seconds, monotonic. Without a clock, the first call, and the first call after
                `pause`, `resume` or `change_speed`, lets no time pass: simulated time goes on from there.
        """
        if self._origin is None:
            self._origin = (now, self._time)
        self._time = self._time_at(now)
        self._engine.run(self._time)

    def deadline(self) -> float | None:
        """Return when the next points are to change, in seconds of the clock.

        None if no point has a behaviour, while the simulation is paused, and without a clock before the first `tick`.
        """
        due = self._engine.deadline()
        if due is None or self._origin is None:
            return None
        if self.is_paused:
            return None
        began, time = self._origin
        return began + (due - time) / self.speed

    def change_speed(self, speed: float) -> None:
        """Change the speed of the simulated time from now on. Call this in the thread of the event loop, if one runs.

        Args:
            speed: seconds of the simulation in one second of the clock, above 0.

        Raises:
            ConfigError: the speed is 0, negative, infinite or NaN.
        """
        _check_speed(speed)
        self._count_from_here()
        self.speed = speed
        self._arm_if_running()

    def pause(self) -> None:
        """Stop the simulated time: points keep their values and can still be set; requests are still answered.

        Call this in the thread of the event loop, if one runs.
        """
        self._count_from_here()
        self.is_paused = True
        self._arm_if_running()

    def resume(self) -> None:
        """Continue the simulated time from where `pause` stopped it.

        Call this in the thread of the event loop, if one runs.
        """
        self._count_from_here()
        self.is_paused = False
        self._arm_if_running()

    def _arm_if_running(self) -> None:
        if self._loop is not None:
            self._arm()

    def _count_from_here(self) -> None:
        """Count simulated time from this moment on, because its speed is about to change or it is to stop or go on.

        Without a clock, it is counted from the next `tick` on.
        """
        if self._clock is None:
            self._origin = None
        elif self._origin is not None:
            now = self._clock.now()
            self._origin = (now, self._time_at(now))

    def _time_at(self, now: float) -> float:
        if self._origin is None:
            return self._time
        began, time = self._origin
        passed = 0.0 if self.is_paused else (now - began) * self.speed
        return max(time + passed, self._time)

    # ---- what a server needs (`busway.apps.service.service_interfaces.DeclaredServer`)

    @property
    def file(self) -> SimulationFile:
        """The sections of the simulation file, with the units of all includes."""
        return self.declaration.file

    @property
    def listeners(self) -> tuple[Listener, ...]:
        """The listeners that the simulation file declares."""
        return self.declaration.configuration.listeners

    @property
    def access(self) -> AccessRules | None:
        """The access rules of the simulation file; None without any."""
        return self.declaration.configuration.access

    @property
    def audit(self) -> str | None:
        """The path of the audit log that the simulation file declares; None without one."""
        return self.declaration.configuration.audit

    @property
    def control(self) -> str | None:
        """The path or address of the control socket; None for the default one, or if the file switches it off.

        ``file.control_parameters.enabled`` tells which.
        """
        return self.declaration.configuration.control

    @property
    def at_once(self) -> frozenset[str]:
        """The names of the file's sections whose changes a reload applies without a restart."""
        return self.declaration.configuration.at_once

    def serve(self, listen: Iterable[str | Listener] = (), **options: Any) -> "Server":  # Any: as `busway.serve`
        """Create a server for the units, with the faults and observers of the simulation; it is not started yet.

        Args:
            listen: URLs or listeners instead of the file's; empty to use the file's.
            options: options of `busway.serve`, instead of the file's.

        Raises:
            ConfigError: an option is invalid, or the file has no unit.
        """
        server = self.declaration.configuration.serve(
            listen, **{"units": {number: unit.device for number, unit in self.units.items()}, **options}
        )
        self.switchboard.attach(server)
        for observer in self._observers:
            server.observe(observer)
        return server

    async def apply_to(
        self,
        running: object,
        listen: Sequence[Listener],
        *,
        policy: Policy | None,
        when_applied: Callable[[Sequence[str]], None],
    ) -> list[str]:
        """Call ``when_applied``, and return an empty list: new units and listeners take effect at the next start."""
        when_applied(())
        return []

    @property
    def functions(self) -> FunctionTable:
        """The table of function codes, with their messages, that the simulation's server decodes."""
        return STANDARD

    def observe(self, observer: RequestObserver) -> None:
        """Register an observer of the requests of every server that `serve` creates from now on."""
        self._observers.append(observer)

    # ---- running

    @property
    def server(self) -> "Server":
        """The server passed to `driven`, while that context lasts. Raises `ConfigError` at any other time."""
        if self._server is None:
            raise ConfigError("the simulation does not run", key="server")
        return self._server

    @asynccontextmanager
    async def running(self, *listen: str) -> AsyncIterator[Self]:
        """Serve the units and run their behaviours while the context lasts.

        To be used as ``async with simulation.running("tcp://127.0.0.1:0"): …``.

        Args:
            listen: URLs to listen on, instead of the file's; none to use the file's.

        Raises:
            ConfigError: a listener cannot be used as configured.
            LinkDown: a listener cannot be opened.
        """
        server = self.serve(listen)
        # The server ends first: what it still takes is kept.
        async with self.driven(server), server:
            yield self

    @asynccontextmanager
    async def driven(self, server: Any) -> AsyncIterator[Self]:  # Any: what `serve` gave, or a `Service` started
        """Run the behaviours of the points while the context lasts; starts and stops no server.

        If the file names a file for the state (``keep``), the state is saved regularly and at the end.

        Args:
            server: the server that serves the units, for the property `server`; its creator starts and stops it.
        """
        self._server = server
        self._loop, self._thread = asyncio.get_running_loop(), threading.get_ident()
        if self._clock is None:
            self._clock = _LoopClock()
            self._origin = (self._clock.now(), self._time)
            owns_clock = True
        else:
            owns_clock = False
        self._arm()
        ended = asyncio.Event()
        every = self.declaration.file.simulation.keep_every
        keeping = asyncio.create_task(self._kept.save_every(every, lambda: self.time, ended))
        try:
            yield self
        finally:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            ended.set()
            with suppress(asyncio.CancelledError):
                await keeping
            self._time = self.time
            if owns_clock:
                self._clock = self._origin = None
            self._server = self._loop = self._thread = None
            self.keep()

    def _arm(self) -> None:
        """Set the timer to the time at which the next points change; without such a time, only cancel the timer."""
        clock, deadline = self._clock, self.deadline()
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if clock is None or deadline is None else clock.call_at(deadline, self._on_timer)

    def _on_timer(self) -> None:
        clock = self._clock
        assert clock is not None  # it called
        began = clock.now()
        self._time = self._time_at(began)
        due, deadline = self._engine.deadline(), self.deadline()
        if due is not None and deadline is not None and began >= deadline:
            # Speed times seconds may be a little less than what is due, and the timer would be set to this same moment.
            self._time = max(self._time, due)
        ends = began + SLICE
        is_done = self._engine.run(self._time, skip=isinstance(clock, _LoopClock), pause=lambda: clock.now() > ends)
        if is_done:
            self._arm()
        else:
            self._timer = clock.call_at(clock.now(), self._on_timer)

    # ---- changes

    def _followed(self, points: list[SimulatedPoint], time: float) -> None:
        """Report new values that behaviours have given to points to the functions of `watch`. Called by the engine."""
        if self._watchers:
            self._notify(
                [PointChanged(point, point.section.physical(point.stored), time, SIMULATION) for point in points]
            )

    def _written(self, points: Sequence[SimulatedPoint], peer: str) -> None:
        """Hold points that a Modbus client has written, and report them to the functions of `watch`.

        Called with the device's lock held.
        """
        for point in points:
            point.look()
        self._notify(self._held(points, peer))

    def _held(self, points: Sequence[SimulatedPoint], who: str) -> list[PointChanged]:
        """Hold points at values that were just set, and return the changes for the functions of `watch`.

        Returns an empty list if no function is registered.

        Args:
            points: points whose registers have their new value.
            who: name of the writer.
        """
        time = self.time
        changes = []
        for point in points:
            point.changed_at = time
            point.last_writer = who
            self._engine.hold(point, time)
            if self._watchers:
                changes.append(PointChanged(point, point.value, time, who))
        if self._loop is not None:
            # A hold may end before whatever was due next.
            if threading.get_ident() == self._thread:
                if self._timer is not None:
                    self._arm()
            else:
                self._loop.call_soon_threadsafe(self._arm)
        return changes

    def _notify(self, changes: list[PointChanged]) -> None:
        if not changes:
            return
        for watcher in self._watchers:
            try:
                watcher(changes)
            except Exception:
                _log.exception("a watcher of points failed")

    def keep(self) -> None:
        """Save the state of the simulation now, if its file names a state file (``keep``). Failures are logged."""
        self._kept.save(self.time)


def _check_speed(speed: float) -> None:
    if not 0 < speed < math.inf:
        raise ConfigError(f"must be above 0, not {speed:g}", key="speed")
