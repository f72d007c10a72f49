"""Every listener with every line behind: one suite of requests, the same answers."""

import contextlib
import itertools
from collections.abc import AsyncIterator

import pytest
from whole_frames import line_of_whole_frames

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from busway.apps.gateway.routes import Route, RoutingTable
from busway.pdu.unknown_functions import OpaqueRequest
from busway.server.listener import Listener
from busway.testing.certificates import CertificateFiles, CertificateStore

pytestmark = pytest.mark.alone

BAUD = 115_200
KINDS = ("tcp", "tls", "udp", "rtu+tcp", "ascii+tcp", "rtu+udp", "rtu", "ascii")
UNITS = (3, 9)


Files = tuple[CertificateFiles, CertificateFiles]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """Of a server and of a client."""
    store = CertificateStore(tmp_path_factory.mktemp("certificates"))
    return store.server(), store.client()


def device(unit: int) -> busway.Device:
    """Register n of unit u holds 1000 u + n."""
    return busway.Device(
        holding_registers=[1000 * unit + n for n in range(200)],
        input_registers=[1000 * unit + n for n in range(200)],
        coils=[(unit + n) % 3 == 0 for n in range(200)],
        discrete_inputs=[(unit + n) % 5 == 0 for n in range(200)],
        identification={0: b"unit", 1: str(unit).encode(), 2: b"1"},
    )


class SocketAddresses:
    """Where a server listens and where its client connects, for one kind of endpoint."""

    def __init__(self, kind: str, files: Files, stack: contextlib.ExitStack) -> None:
        self._port: str | None = None
        self.client_options = self.listen = ""
        if kind in ("rtu", "ascii"):
            line = stack.enter_context(line_of_whole_frames(ports=2, baud=BAUD, data_bits=8 if kind == "rtu" else 7))
            self.listen = f"{kind}://{line.paths[0]}?baud={BAUD}"
            self._port = f"{kind}://{line.paths[1]}?baud={BAUD}"
        elif kind == "tls":
            self.listen = f"tls://127.0.0.1:0?{files[0].query()}"
            self.client_options = f"?{files[1].query()}"
        else:
            self.listen = f"{kind}://127.0.0.1:0"

    def client(self, bound: str) -> str:
        """The URL for a client, where a server is bound there."""
        return self._port or bound + self.client_options


@contextlib.asynccontextmanager
async def gateway_between(listener: str, line: str, files: Files) -> AsyncIterator[busway.AsyncLink]:
    with contextlib.ExitStack() as lines:
        outer, inner = SocketAddresses(listener, files, lines), SocketAddresses(line, files, lines)
        async with busway.serve(inner.listen, units={unit: device(unit) for unit in UNITS}) as server:
            plan = GatewayPlan(
                listeners=(GatewayListener("office", Listener(outer.listen)),),
                upstreams=(UpstreamSettings.of("line", inner.client(server.endpoints[0]), timeout=2.0),),
                table=RoutingTable((Route(upstream="line", units=frozenset({*UNITS, 30})),)),
                own_unit=None,
            )
            async with (
                Gateway(plan) as gateway,
                busway.open(outer.client(gateway.endpoints[0]), timeout=4.0, retries=0) as link,
            ):
                yield link


@pytest.mark.clause("T32")
@pytest.mark.parametrize(("listener", "line"), list(itertools.product(KINDS, KINDS)))
async def test_every_listener_serves_every_line(listener: str, line: str, files: Files) -> None:
    async with gateway_between(listener, line, files) as link:
        for number in UNITS:
            unit = link.unit(number)
            assert await unit.read_holding_registers(7, count=3) == [1000 * number + n for n in (7, 8, 9)]
            assert await unit.read_coils(3, count=11) == [(number + n) % 3 == 0 for n in range(3, 14)]
        unit = link.unit(UNITS[0])
        assert len(await unit.read_input_registers(0, count=125)) == 125
        assert await unit.read_discrete_inputs(1, count=2) == [(UNITS[0] + n) % 5 == 0 for n in (1, 2)]
        await unit.write_multiple_registers(10, [7, 8, 9])
        await unit.write_single_register(11, 77)
        assert await unit.read_holding_registers(10, count=3) == [7, 77, 9]
        await unit.write_single_coil(5, True)
        await unit.write_multiple_coils(6, [True, False, True])
        assert await unit.read_coils(5, count=4) == [True, True, False, True]
        assert await unit.read_write_multiple_registers(10, count=2, write_address=10, values=[1]) == [1, 77]
        assert (await unit.read_device_identification())[1] == str(UNITS[0]).encode()
        for refused, code in (
            (unit.read_holding_registers(199, count=2), 2),
            (unit.execute(OpaqueRequest(0x41, b"\x01\x02")), 1),
        ):
            with pytest.raises(busway.ExceptionReply) as error:
                await refused
            assert error.value.code == code
