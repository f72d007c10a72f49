"""Who wants to is told of every way by which bytes leave a server, and sends and closes by it."""

import asyncio
from urllib.parse import urlsplit

import pytest
from waiting import until

import busway
from busway.framing.mbap import encode_mbap
from busway.framing.rtu import encode_rtu
from busway.server.wires import Wire
from busway.testing.line import PacedLine

READ = bytes.fromhex("03 0000 0001")
REPLY = bytes.fromhex("03 02 0000")


class Told:
    """Keeps the wires that are there."""

    def __init__(self) -> None:
        self.wires: list[Wire] = []
        self.gone: list[Wire] = []

    def came(self, wire: Wire) -> None:
        self.wires.append(wire)

    def left(self, wire: Wire) -> None:
        self.wires.remove(wire)
        self.gone.append(wire)


async def _connected(server: busway.Server) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    return await asyncio.open_connection("127.0.0.1", urlsplit(server.endpoints[0]).port)


@pytest.mark.parametrize(("scheme", "framing"), [("tcp", "mbap"), ("rtu+tcp", "rtu"), ("ascii+tcp", "ascii")])
async def test_connection_is_a_wire_that_sends_bytes_as_they_are_and_closes_behind_them(
    scheme: str, framing: str
) -> None:
    told = Told()
    server = busway.serve(f"{scheme}://127.0.0.1:0", units={1: busway.Device(holding_registers=1)})
    server.use_tap(told)
    async with server:
        reader, writer = await _connected(server)
        await until(lambda: len(told.wires) == 1)
        (wire,) = told.wires
        host, port = writer.get_extra_info("sockname")[:2]
        assert (wire.peer, wire.listener) == (f"{host}:{port}", server.endpoints[0])
        assert (wire.framing, wire.carrier, wire.gap) == (framing, "tcp", 0.0)
        wire.send(b"what")
        wire.send(b"ever")
        asyncio.get_running_loop().call_soon(wire.close)
        assert await asyncio.wait_for(reader.read(), 5) == b"whatever"
        await until(lambda: told.gone == [wire])
        wire.send(b"nobody is there any more")
        writer.close()
        await writer.wait_closed()


async def test_two_connections_are_two_wires() -> None:
    told = Told()
    server = busway.serve("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=1)})
    server.use_tap(told)
    async with server:
        ends = [await _connected(server) for _ in range(2)]
        await until(lambda: len(told.wires) == 2)
        assert told.wires[0].peer != told.wires[1].peer
        for _, writer in ends:
            writer.close()
            await writer.wait_closed()
        await until(lambda: told.wires == [])
    assert len(told.gone) == 2


async def test_peer_over_udp_is_a_wire_that_can_not_be_closed() -> None:
    told = Told()
    server = busway.serve("udp://127.0.0.1:0", units={1: busway.Device(holding_registers=1)})
    server.use_tap(told)
    async with server, busway.open(server.endpoints[0]) as link:
        await link.unit(1).read_holding_registers(0, count=1)
        (wire,) = told.wires
        assert (wire.framing, wire.carrier) == ("mbap", "udp")
        wire.close()
        await link.unit(1).read_holding_registers(0, count=1)
        assert told.wires == [wire]
    assert told.wires == []


@pytest.mark.real_time
async def test_open_port_is_a_wire_as_long_as_it_is_open() -> None:
    told = Told()
    with PacedLine(ports=2, baud=115_200) as line:
        server = busway.serve(f"rtu://{line.paths[1]}?baud=115200", units={1: busway.Device(holding_registers=1)})
        server.use_tap(told)
        async with server:
            (wire,) = told.wires
            assert (wire.framing, wire.carrier) == ("rtu", "serial")
            assert wire.listener == wire.peer == server.endpoints[0]
            assert wire.gap == pytest.approx(0.00175)
            wire.send(b"\x00\xff")
            await until(lambda: b"".join(talk.data for talk in line.transmissions() if talk.port == 1) == b"\x00\xff")
            await asyncio.sleep(3 * wire.gap)  # the silence that a master keeps before it asks
            line.inject(encode_rtu(1, READ))
            await until(lambda: encode_rtu(1, REPLY) in b"".join(one.data for one in line.transmissions()))
            spoken = b"".join(talk.data for talk in line.transmissions() if talk.port == 1)
            assert spoken == b"\x00\xff" + encode_rtu(1, REPLY)
            line.unplug(1)
            await until(lambda: told.gone == [wire])
            wire.send(b"the port is not there")
        assert told.gone == [wire]


async def test_server_that_nobody_wants_the_wires_of_makes_none() -> None:
    async with busway.serve("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=1)}) as server:
        reader, writer = await _connected(server)
        writer.write(encode_mbap(1, 1, READ))
        assert await asyncio.wait_for(reader.readexactly(11), 5) == encode_mbap(1, 1, REPLY)
        with pytest.raises(busway.ConfigError, match="a running server has its ways already"):
            server.use_tap(Told())
        writer.close()
        await writer.wait_closed()
