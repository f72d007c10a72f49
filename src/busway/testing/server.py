"""A Modbus TCP server with faults, for tests of clients: the real server with a real device, and faults between them.

Knows an event loop and a clock; faults, and how they reach connections, are in `busway.faults`.

::

    with busway.testing.faulty_server(device, "late", delay=1.5) as server:
        with busway.connect(server.endpoint, timeout=0.5) as link: ...

    async with busway.testing.FaultyServer(device) as server:
        busy = server.add("busy", units={2})
        ...
        busy.off()
"""

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from types import TracebackType
from typing import Any, Self

from ..errors import ConfigError
from ..faults.applied_faults import AppliedFault, Faults, Schedule, Selection
from ..faults.clock import Clock, LoopClock
from ..faults.fault import Exchange, Fault
from ..faults.faulty_connections import FaultyTap
from ..faults.faulty_responder import FaultyResponder
from ..faults.profiles import FAULT_PROFILES
from ..options.server import UnitPolicy
from ..pdu.functions import STANDARD, FunctionTable
from ..server.device import Device
from ..server.device_responder import DeviceResponder
from ..server.server import Server

REMEMBERED_REQUESTS = 10_000
"""Number of requests that a server keeps in its list ``requests``."""
LONGEST_WAIT = 10.0
"""Most seconds to wait for a condition; then waiting fails with `TimeoutError`."""


class FaultyServer:
    """A Modbus TCP server with faults; an asynchronous context manager. Faults can be added from any thread.

    Args:
        device: the device that answers for every unit; or devices by unit identifier, 0…255.
        fault_profiles: the faults from the beginning on: names of fault profiles, or faults.
        seed: seed of random choices.
        clock: clock of delays; the event loop's by default.
        host: address to listen on; the system chooses a free port.
        functions: the table of functions.
        options: parameters of the named fault profiles; each profile gets those that it has.

    Raises:
        ConfigError: an unknown name or parameter.

    Attributes:
        endpoint: URL of the server; empty before it is started.
        loop: its event loop; None before it is started.
        faults: the faults that the server has now.
        requests: the requests received, in order; the latest `REMEMBERED_REQUESTS`.
    """

    def __init__(
        self,
        device: Device | Mapping[int, Device],
        *fault_profiles: str | Fault,
        seed: int = 0,
        clock: Clock | None = None,
        host: str = "127.0.0.1",
        functions: FunctionTable = STANDARD,
        **options: Any,  # Any: what the fault profiles take
    ) -> None:
        units = {1: device} if isinstance(device, Device) else device
        policy = UnitPolicy.ANY if isinstance(device, Device) else UnitPolicy.LISTED
        self._changed = threading.Condition()
        self._changed_here = asyncio.Event()
        self._clock = clock
        self.loop: asyncio.AbstractEventLoop | None = None
        self.endpoint: str = ""
        self.requests: deque[Exchange] = deque(maxlen=REMEMBERED_REQUESTS)
        self.faults: Faults = Faults(seed)
        for fault in _faults_of(fault_profiles, options):
            self.faults.add(fault)
        self._tap = FaultyTap(self.faults, clock, changed=self._change)
        responder = DeviceResponder(units, unit_policy=policy, functions=functions)
        self._server = Server(
            [f"tcp://[{host}]:0" if ":" in host else f"tcp://{host}:0"],
            FaultyResponder(responder, self.faults, self._tap, heard=self._heard),
            tap=self._tap,
            standard_port=False,
        )

    def add(
        self,
        fault_profile: str | Fault,
        *,
        units: Collection[int] | None = None,
        functions: Collection[int] | None = None,
        addresses: range | None = None,
        probability: float = 1.0,
        schedule: Schedule | None = None,
        **options: Any,  # Any: what the fault profile takes
    ) -> AppliedFault:
        """Add a fault to the server.

        Args:
            fault_profile: the name of a fault profile, or a fault.
            units: unit identifiers of the requests that it applies to, 0…255; None for all.
            functions: function codes of those requests, 1…127; None for all.
            addresses: range of items, 0-based, in every table: requests that read or write one of them. None for all.
            probability: share of those requests that it changes, 0…1.
            schedule: when it is active; None for always.
            options: parameters of the fault profile.

        Returns:
            The added fault: ``on()`` and ``off()`` switch it, ``struck`` is the number of requests it has changed.

        Raises:
            ConfigError: an unknown name or parameter, or a value out of its range.
        """
        (fault,) = _faults_of((fault_profile,), options)
        selection = Selection(units, functions, addresses, probability, schedule or Schedule())
        return self.faults.add(fault, selection)

    @property
    def clock(self) -> Clock:
        """The clock that times delayed replies. Available once the server has been started."""
        assert self._clock is not None, "the server has not been started"
        return self._clock

    @property
    def connections(self) -> int:
        """Number of client connections open now."""
        return len(self._tap)

    @property
    def accepted(self) -> int:
        """Number of client connections accepted so far."""
        return self._tap.accepted

    async def start(self) -> None:
        """Start the faulty server on a free port of ``host``; ``endpoint`` is its URL then."""
        self.loop = asyncio.get_running_loop()
        if self._clock is None:
            self._clock = LoopClock(self.loop)
        await self._server.start()
        (self.endpoint,) = self._server.endpoints

    async def stop(self) -> None:
        """Stop the server and close all its connections."""
        self._drop()
        await self._server.stop()
        await self.until(lambda: not self.connections)

    def drop_connections(self) -> None:
        """Close all client connections soon; may be called from any thread once the server has been started."""
        assert self.loop is not None
        self.loop.call_soon_threadsafe(self._drop)

    def _drop(self) -> None:
        for faulty in self._tap:
            faulty.connection.close()

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait in the server's event loop until ``condition`` returns True.

        The condition is called at once, and again whenever a request was received or a connection opened or closed.

        Raises:
            TimeoutError: the condition did not return True within `LONGEST_WAIT` seconds.
        """
        async with asyncio.timeout(LONGEST_WAIT):
            while not condition():
                self._changed_here.clear()
                await self._changed_here.wait()

    def wait_until(self, condition: Callable[[], bool]) -> None:
        """Block, in any thread but the server's, until ``condition`` returns True.

        The condition is called at once, and again whenever a request was received or a connection opened or closed.

        Raises:
            TimeoutError: the condition did not return True within `LONGEST_WAIT` seconds.
        """
        with self._changed:
            if not self._changed.wait_for(condition, LONGEST_WAIT):
                raise TimeoutError("what the test waits for did not happen")

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop()

    def _heard(self, exchange: Exchange) -> None:
        self.requests.append(exchange)
        self._change()

    def _change(self) -> None:
        """Let `wait_until` and `until` call their conditions again: a request was received or a connection changed."""
        self._changed_here.set()
        with self._changed:
            self._changed.notify_all()


@contextlib.contextmanager
def faulty_server(
    device: Device | Mapping[int, Device], *fault_profiles: str | Fault, **options: Any
) -> Iterator[FaultyServer]:  # Any: as FaultyServer says
    """Context manager that runs a `FaultyServer` in a thread of its own, for blocking clients; yields the server.

    The arguments are those of `FaultyServer`; ``seed``, ``clock``, ``host`` and ``functions`` may be among ``options``.
    """
    server = FaultyServer(device, *fault_profiles, **options)
    thread = _ServerThread(server)
    thread.start()
    try:
        yield server
    finally:
        thread.stop()


class _ServerThread:
    """A thread with an event loop that runs one `FaultyServer`."""

    def __init__(self, server: FaultyServer) -> None:
        self._server = server
        self._started = threading.Event()
        self._end: asyncio.Event | None = None
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._serve, name="busway faults", daemon=True)

    def start(self) -> None:
        """Start the thread and the server; raises the error if the server cannot start."""
        self._thread.start()
        self._started.wait()
        if self._failure is not None:
            self._thread.join()
            raise self._failure

    def stop(self) -> None:
        """Stop the server and wait until its thread has ended."""
        if self._end is not None and self._server.loop is not None:
            self._server.loop.call_soon_threadsafe(self._end.set)
        self._thread.join()

    def _serve(self) -> None:
        try:
            with asyncio.Runner() as runner:
                runner.run(self._run())
        except BaseException as error:
            if self._started.is_set():
                raise
            self._failure = error
            self._started.set()

    async def _run(self) -> None:
        await self._server.start()
        self._end = asyncio.Event()
        self._started.set()
        await self._end.wait()
        await self._server.stop()


def _faults_of(fault_profiles: tuple[str | Fault, ...], options: Mapping[str, Any]) -> list[Fault]:
    """Create the faults for these profiles; each named profile gets those of ``options`` that are its parameters.

    Raises `ConfigError` for an option that no profile has.
    """
    named = [one if isinstance(one, Fault) else FAULT_PROFILES.named(one) for one in fault_profiles]
    known = {option for one in named if not isinstance(one, Fault) for option in one.options}
    for option in options:
        if option not in known:
            raise ConfigError(f"none of the fault profiles has the option {option}", key=option)
    return [
        one
        if isinstance(one, Fault)
        else one(**{option: value for option, value in options.items() if option in one.options})
        for one in named
    ]
