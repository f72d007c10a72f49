"""A simulated device for tests: values or a file, served in a thread of its own, with faults as context managers.

Knows simulations and threads; knows no test framework (`busway.testing.plugin` does).

::

    with simulated_device({"4x1": 42, "4x11": 21.5, "0x1": True}) as device:
        talk_to(device.endpoint)
        with device.fault("late", delay=2.0):
            talk_to(device.endpoint)
        assert device["4x1"] == 43

1. The server runs in a thread: a test may block, sleep or run an event loop of its own, and the device still answers.
2. ``reads`` and ``writes`` have only the accesses of clients, in order, and not those of the test.
"""

import asyncio
import contextlib
import os
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ..codes import Table
from ..errors import ConfigError, InvalidRequest
from ..values import Address, format_address, parse_address, value_type
from ..values.unfit_values import shown

if TYPE_CHECKING:
    from ..apps.simulator.includes import SimulationDeclaration
    from ..apps.simulator.simulation import Simulation
    from ..config.files.simulation import SimulatedPointSection
    from ..faults.applied_faults import AppliedFault
    from ..faults.clock import Clock
    from ..server.hooks import Access, Change

FREE_PORT: Final = "tcp://127.0.0.1:0"
Content = Mapping[str, Any] | str | os.PathLike[str]
"""Values by address, or a file: a simulation file, a register map in CSV, or ``device:NAME``."""


@contextlib.contextmanager
def simulated_device(
    content: Content,
    *,
    unit: int | None = None,
    url: str = FREE_PORT,
    seed: int | None = None,
    speed: float = 1.0,
    clock: "Clock | None" = None,
) -> "Iterator[SimulatedDevice]":
    """Context manager that serves a simulated device from values or a file, in a thread; yields a `SimulatedDevice`.

    Args:
        content: values of the device, or a file. A mapping of addresses (``"4x1"``, ``"holding:0"``, ``"0x1"``) to
            values: ``bool`` for bits; an ``int`` is one register, a ``float`` is float32, a text is a string; ``(value,
            type)`` or ``(value, type, order)`` choose another type; the values of a list follow each other from its
            address on. The device has exactly these items. Or the path of a simulation file (``.toml``), the path of a
            register map (``.csv``), or ``"device:meter"``. Values that a file keeps over restarts are neither restored
            nor saved.
        unit: the unit of values or of a register map, 0…255; None for unit 1, which then answers for all units. A
            simulation file names its units itself: any other value than None is a `ConfigError` then.
        url: where to listen, instead of on the listeners that a file has; a free port of 127.0.0.1 by default.
        seed: seed of noise and random values; None for that of the file, or 0.
        speed: seconds that pass for the device in one real second.
        clock: clock of delays and behaviours, such as a `FakeClock`; the real time by default.

    Raises:
        ConfigError: the content, a value or the URL is invalid.
        LinkDown: the URL cannot be listened on.
    """
    from ..apps.simulator.simulation import Simulation

    simulation = Simulation(_declared(content, unit), clock=clock, seed=seed, speed=speed)
    thread = _Thread(simulation, url)
    thread.start()
    try:
        yield SimulatedDevice(simulation, thread.endpoints)
    finally:
        thread.stop()


class SimulatedDevice:
    """A simulated device that is being served, as `simulated_device` yields it.

    Its methods may be called from any thread.

    Attributes:
        endpoints: URLs of its listeners, with the ports that the system chose.
        simulation: the simulation that provides the values.
        reads: reads by clients that were answered, in order (`Access`): ``unit``, ``table``, ``address``, ``count``,
            ``values``, ``function``.
        writes: writes by clients that were executed, in order (`Change`): the same with ``old`` and ``new`` in place of
            ``values``.
    """

    def __init__(self, simulation: "Simulation", endpoints: Sequence[str]) -> None:
        self.endpoints: list[str] = list(endpoints)
        self.simulation = simulation
        self.reads: list[Access] = []
        self.writes: list[Change] = []
        self._changed = threading.Condition()
        for unit in simulation.units.values():
            for table in Table:
                unit.device.on_read(table, self._was_read, when="after")
                if table.is_writable:
                    unit.device.on_write(table, self._was_written, when="after")

    @property
    def endpoint(self) -> str:
        """URL of the device's first listener: ``tcp://127.0.0.1:40123``."""
        return self.endpoints[0]

    @property
    def host(self) -> str:
        """Host of the device's first listener, for programs that take no URL."""
        from ..options.endpoints import parse_endpoint

        return parse_endpoint(self.endpoint).host

    @property
    def port(self) -> int:
        """Port of the device's first listener. Raises `ConfigError` for a serial port, which has none."""
        from ..options.endpoints import parse_endpoint

        port = parse_endpoint(self.endpoint).port
        if port is None:
            raise ConfigError(f"{self.endpoint} has no port number", key="port")
        return port

    def __getitem__(self, key: str) -> Any:  # what its type says
        """Return the value of a point or item: ``device["tank.level"]``, ``device["3/voltage"]``, ``device["4x1"]``.

        An address gives the point that was declared there. Without a point it gives the item, if there is only one
        unit.

        Raises:
            InvalidRequest: there is no such point and no such item, or several units have it.
        """
        name = self._key(key)
        if name is not None:
            return self.simulation.points[name].value
        return self._only_device(key).read(parse_address(key))

    def __setitem__(self, key: str, value: Any) -> None:  # what its type says
        """Set a point or item, whether clients may write it or not; keys are those of `__getitem__`.

        Raises:
            InvalidRequest: there is no such point or item, or the value does not fit.
        """
        name = self._key(key)
        if name is not None:
            self.simulation.set(name, value, "test")
        else:
            self._only_device(key).write(parse_address(key), value)

    @contextlib.contextmanager
    def fault(
        self,
        fault_profile: str,
        *,
        units: int | Collection[int] | None = None,
        functions: int | Collection[int] | None = None,
        addresses: range | str | Collection[str] | None = None,
        probability: float = 1.0,
        skip: int = 0,
        times: int | None = None,
        **parameters: Any,  # Any: what the fault profile takes
    ) -> "Iterator[AppliedFault]":
        """Context manager that makes the device misbehave: ``with device.fault("late", delay=2.0) as fault: …``.

        Args:
            fault_profile: the name of a fault profile (`busway.testing.FAULT_PROFILES`).
            units: unit identifier of the requests that the fault applies to, 0…255, or several; None for all.
            functions: function code of those requests, 1…127, or several; None for all.
            addresses: the fault applies to requests that read or write one of these items: an address, several, or a
                ``range`` of offsets in any table; None for all.
            probability: share of those requests that it changes, 0…1.
            skip: number of those requests that are answered normally first.
            times: number of requests after these that it applies to; None for any number.
            parameters: the parameters of the fault profile.

        Yields:
            The fault: ``struck`` is the number of requests it has changed, ``off()`` and ``on()`` switch it.

        Raises:
            ConfigError: an unknown name or parameter, or a value out of its range.
        """
        from ..faults.applied_faults import Schedule

        switchboard = self.simulation.switchboard
        name = switchboard.add(
            fault_profile,
            units={units} if isinstance(units, int) else units,
            functions={functions} if isinstance(functions, int) else functions,
            addresses=addresses if isinstance(addresses, range) else None,
            items=None if isinstance(addresses, range) else _items(addresses),
            probability=probability,
            schedule=Schedule(skip=skip, times=times),
            parameters=parameters,
        )
        try:
            yield switchboard.faults.find(name)
        finally:
            switchboard.remove(name)

    def wait_for_write(self, address: str, *, timeout: float = 10.0) -> Any:  # what its type says
        """Block until a client writes an item after this call. Returns the value that the item has then.

        Args:
            address: address of the item, or the name of a point.
            timeout: seconds to wait at most.

        Raises:
            TimeoutError: no client wrote the item in time.
            InvalidRequest: there is no such point, and the text is no address.
        """
        name = self._key(address)
        place = self.simulation.points[name].section.place if name is not None else parse_address(address)
        seen = len(self.writes)

        def is_written() -> bool:
            return any(_touches(each, place) for each in self.writes[seen:])

        with self._changed:
            if not self._changed.wait_for(is_written, timeout):
                raise TimeoutError(f"no client wrote {address} within {timeout:g} s")
        return self[address]

    def _was_read(self, access: "Access") -> None:
        self.reads.append(access)

    def _was_written(self, change: "Change") -> None:
        with self._changed:
            self.writes.append(change)
            self._changed.notify_all()

    def _key(self, key: str) -> str | None:
        """Return the key ``UNIT/NAME`` of the point that a name or address stands for.

        None for an item without a point.
        """
        points = self.simulation.points
        if key in points:
            return key
        own = [f"{unit}/{key}" for unit in self.simulation.units]
        found = [each for each in own if each in points] or self._standing_at(key)
        if len(found) > 1:
            raise InvalidRequest(f"several units have {shown(key)}; name one, {' or '.join(map(repr, found[:3]))}")
        return found[0] if found else None

    def _standing_at(self, key: str) -> list[str]:
        """Return the keys ``UNIT/NAME`` of the points of all units whose address is ``key``, in any notation.

        A point that begins at an earlier register is not among them. Empty if ``key`` is no address.
        """
        try:
            place = parse_address(key)
        except InvalidRequest:
            return []
        return [name for name, point in self.simulation.points.items() if point.section.place == place]

    def _only_device(self, key: str) -> Any:  # a `busway.Device`
        units = list(self.simulation.units.values())
        if len(units) > 1:
            raise InvalidRequest(f"there are several units; name a point, UNIT/NAME, instead of {shown(key)}")
        return units[0].device


class _Thread:
    """The thread that runs the server of a simulated device."""

    def __init__(self, simulation: "Simulation", url: str) -> None:
        self._simulation = simulation
        self._url = url
        self._started = threading.Event()
        self._stop: tuple[asyncio.AbstractEventLoop, asyncio.Event] | None = None
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._serve, name="busway device", daemon=True)
        self.endpoints: list[str] = []

    def start(self) -> None:
        """Start the thread with the device's server; raises the error if the server cannot start."""
        self._thread.start()
        self._started.wait()
        if self._failure is not None:
            self._thread.join()
            raise self._failure

    def stop(self) -> None:
        """Stop the device's server, and wait until its thread has ended."""
        if self._stop is not None:
            loop, event = self._stop
            loop.call_soon_threadsafe(event.set)
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
        async with self._simulation.running(self._url) as simulation:
            self.endpoints = simulation.server.endpoints
            stop = asyncio.Event()
            self._stop = asyncio.get_running_loop(), stop
            self._started.set()
            await stop.wait()


def _declared(content: Content, unit: int | None) -> "SimulationDeclaration":
    """Return the declaration of the simulation for ``content``, which is a file or values by address."""
    from ..apps.simulator.includes import load_declaration, parse_declaration

    if isinstance(content, Mapping):
        return parse_declaration(_text(_checked(content), unit), "the values of the device")
    name = os.fspath(content)
    if Path(name).suffix.lower() == ".csv":
        from ..apps.simulator.csv_register_map import read_register_map

        return parse_declaration(_text(read_register_map(name), unit), name)
    if unit is not None:
        raise ConfigError("stands in the file", key="unit")
    # What one test leaves must not be where the next one begins.
    return replace(load_declaration(name), state=None)


def _text(points: "Sequence[SimulatedPointSection]", unit: int | None) -> str:
    """Return the text of a device file with one unit that has these points.

    Without ``unit`` it is unit 1, which answers for all units.
    """
    from ..apps.simulator.device_text import device_text
    from ..config.files.simulation import SimulatedUnitSection

    if unit is not None and not 0 <= unit <= 255:
        raise ConfigError(f"must be 0…255, not {unit}", key="unit")
    section = SimulatedUnitSection.model_validate({"unit": 1 if unit is None else unit, "point": list(points)})
    return ('[server]\nunit_policy = "any"\n\n' if unit is None else "") + device_text([section])


def _checked(content: Mapping[str, Any]) -> "list[SimulatedPointSection]":
    """Return the points to declare for a mapping of addresses to values. Raises `ConfigError` for a wrong address."""
    from ..config.files.file_error import FileError
    from ..config.files.simulation import SimulatedUnitSection
    from ..config.files.toml_source import Source

    keys = [each for address, value in content.items() for each in _points(address, value)]
    if not keys:
        raise ConfigError("a device needs a value at least", key="content")
    lines: dict[tuple[str | int, ...], int] = {
        ("point", index): index for index in range(len(keys))
    }  # the line of a problem says whose it is
    try:
        return list(Source("", {"unit": 1, "point": keys}, lines).checked(SimulatedUnitSection).point)
    except FileError as error:
        raise ConfigError(error.message, key=keys[error.line or 0]["name"]) from None


def _points(address: str, value: Any) -> Iterator[dict[str, Any]]:
    """Yield for each value at an address a dict with the keys and values that declare its point in a device file."""
    place = parse_address(address)
    if place.table is None:
        raise ConfigError("does not say which table; write 4x1 or holding:0", key=address)
    offset = place.offset
    for index, each in enumerate(value if isinstance(value, list) else [value]):
        written = format_address(Address(place.table, offset, place.bit))
        kind = _kind(address, each)
        yield {"name": address if index == 0 else written, "address": written, **kind}
        try:
            offset += value_type(kind.get("type", "uint16"), kind.get("order", "ABCD")).registers
        except InvalidRequest as error:
            raise ConfigError(error.message, key=address) from None


def _kind(address: str, value: Any) -> dict[str, Any]:
    """Return the keys of a device file that declare a point's value, and its type, which follows from the value."""
    if isinstance(value, tuple) and 2 <= len(value) <= 3:
        return dict(zip(("value", "type", "order"), value, strict=False))
    if isinstance(value, bool):
        return {"value": value}
    if isinstance(value, int):
        return {"value": value, "type": "int16"} if value < 0 else {"value": value}
    if isinstance(value, float):
        return {"value": value, "type": "float32"}
    if isinstance(value, str):
        return {"value": value, "type": f"string:{max(2, len(value.encode()))}:utf-8"}
    raise ConfigError(
        f"a value is a number, a text, a bool, a tuple (value, type) or a list, not {shown(value)}", key=address
    )


def _items(addresses: str | Collection[str] | None) -> dict[Table, list[tuple[int, int]]] | None:
    """Return the addresses that a fault applies to as item ranges by table; None for all."""
    if addresses is None:
        return None
    found: dict[Table, list[tuple[int, int]]] = {}
    for text in [addresses] if isinstance(addresses, str) else addresses:
        place = parse_address(text)
        if place.table is None:
            raise ConfigError(f"{text} does not say which table; write 4x1 or holding:0", key="addresses")
        found.setdefault(place.table, []).append((place.offset, place.offset + 1))
    return found


def _touches(change: "Change", place: Address) -> bool:
    return change.table is place.table and change.address <= place.offset < change.address + change.count
