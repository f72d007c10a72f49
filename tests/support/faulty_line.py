"""A line behind a gateway with two units on it, of which one misbehaves: on TCP, over a network, and on a wire."""

import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field, replace

from whole_frames import line_of_whole_frames

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from busway.apps.gateway.routes import Route, RoutingTable
from busway.faults.applied_faults import AppliedFault, Faults, Selection
from busway.faults.faulty_connections import FaultyTap
from busway.faults.faulty_responder import FaultyResponder
from busway.faults.profiles import FAULT_PROFILES
from busway.server.device_responder import DeviceResponder
from busway.server.listener import Listener
from busway.server.server import Server

ANY_PORT = "tcp://127.0.0.1:0"
BAUD = 115_200
UNITS = (1, 2)
SIZE = 400
LONGEST_WAIT = 5.0
"""Seconds for what comes."""


def value(unit: int, address: int) -> int:
    """What a register holds."""
    return 1000 * unit + address


@dataclass
class FaultyLine:
    """The gateway, what is behind it, and what goes wrong there.

    Attributes:
        gateway: the gateway, whose only listener is on TCP.
        server: the units.
        faults: on the line.
        devices: by unit.
        written: what each was told to write, in order.
    """

    gateway: Gateway
    server: Server
    faults: Faults
    devices: dict[int, busway.Device]
    written: dict[int, list[list[int]]] = field(default_factory=dict)

    @property
    def endpoint(self) -> str:
        """Where clients reach the gateway."""
        return self.gateway.endpoints[0]

    def add(self, name: str, unit: int | None = 1, **options: object) -> AppliedFault:
        """Let a unit misbehave; None: all of them."""
        selection = Selection() if unit is None else Selection(units={unit})
        return self.faults.add(FAULT_PROFILES.named(name)(**options), selection)

    def off(self) -> None:
        """Let all behave again."""
        for one in self.faults:
            one.off()


@contextlib.asynccontextmanager
async def faulty_line(
    carrier: str, *, route: Route | None = None, listener: str = ANY_PORT, **options: object
) -> AsyncIterator[FaultyLine]:
    """A gateway in front of such a line.

    Args:
        carrier: scheme of the line: ``tcp``, ``rtu+tcp``, ``ascii+tcp``, ``rtu`` or ``ascii``.
        route: the one to the line, ``line``; all units as they are by default.
        listener: where clients come.
        options: of the line.
    """
    with contextlib.ExitStack() as stack:
        if carrier in ("rtu", "ascii"):
            wire = stack.enter_context(line_of_whole_frames(ports=2, baud=BAUD, data_bits=8 if carrier == "rtu" else 7))
            listen, dial = (f"{carrier}://{path}?baud={BAUD}" for path in wire.paths)
        else:
            listen, dial = f"{carrier}://127.0.0.1:0", ""
        faults = Faults(7)
        tap = FaultyTap(faults)
        devices = {unit: busway.Device(holding_registers=[value(unit, n) for n in range(SIZE)]) for unit in UNITS}
        written: dict[int, list[list[int]]] = {unit: [] for unit in UNITS}
        for unit, device in devices.items():
            device.on_write("holding_registers", lambda change, seen=written[unit]: seen.append(change.new))
        server = Server([listen], FaultyResponder(DeviceResponder(devices), faults, tap), tap=tap, standard_port=False)
        async with server:
            base = route or Route(upstream="line", units=frozenset(range(1, 248)))
            patient = replace(base, units=frozenset({2}), timeout=LONGEST_WAIT)  # who behaves has time
            plan = GatewayPlan(
                listeners=(GatewayListener("office", Listener(listener)),),
                upstreams=(UpstreamSettings.of("line", dial or server.endpoints[0], **options),),
                table=RoutingTable((patient, base)),
            )
            async with Gateway(plan) as gateway:
                yield FaultyLine(gateway, server, faults, devices, written)
