"""A tap sees all bytes that leave a server, whichever way they take, and can send on connections and close them."""

import asyncio
from urllib.parse import urlsplit

import pytest
from waiting import until
from whole_frames import line_of_whole_frames

import busway
from busway.framing.mbap import encode_mbap
from busway.framing.rtu import encode_rtu
from busway.server.connection_tap import TappedConnection

READ = bytes.fromhex("03 0000 0001")
REPLY = bytes.fromhex("03 02 0000")


class Told:
    """Keeps the taps of open connections."""

    def __init__(self) -> None:
        self.open_connections: list[TappedConnection] = []
        self.gone: list[TappedConnection] = []

    def connection_opened(self, connection: TappedConnection) -> None:
        self.open_connections.append(connection)

    def connection_closed(self, connection: TappedConnection) -> None:
        self.open_connections.remove(connection)
        self.gone.append(connection)


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
        await until(lambda: len(told.open_connections) == 1)
        (connection,) = told.open_connections
        host, port = writer.get_extra_info("sockname")[:2]
        assert (connection.peer, connection.listener) == (f"{host}:{port}", server.endpoints[0])
        assert (connection.framing, connection.carrier, connection.gap) == (framing, "tcp", 0.0)
        connection.send(b"what")
        connection.send(b"ever")
        asyncio.get_running_loop().call_soon(connection.close)
        assert await asyncio.wait_for(reader.read(), 60) == b"whatever"
        await until(lambda: told.gone == [connection])
        connection.send(b"the peer is gone")
        writer.close()
        await writer.wait_closed()


async def test_two_connections_have_two_taps() -> None:
    told = Told()
    server = busway.serve("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=1)})
    server.use_tap(told)
    async with server:
        ends = [await _connected(server) for _ in range(2)]
        await until(lambda: len(told.open_connections) == 2)
        assert told.open_connections[0].peer != told.open_connections[1].peer
        for _, writer in ends:
            writer.close()
            await writer.wait_closed()
        await until(lambda: told.open_connections == [])
    assert len(told.gone) == 2


async def test_peer_over_udp_is_a_wire_that_cannot_be_closed() -> None:
    told = Told()
    server = busway.serve("udp://127.0.0.1:0", units={1: busway.Device(holding_registers=1)})
    server.use_tap(told)
    async with server, busway.open(server.endpoints[0]) as link:
        await link.unit(1).read_holding_registers(0, count=1)
        (connection,) = told.open_connections
        assert (connection.framing, connection.carrier) == ("mbap", "udp")
        connection.close()
        await link.unit(1).read_holding_registers(0, count=1)
        assert told.open_connections == [connection]
    assert told.open_connections == []


@pytest.mark.real_time
async def test_open_port_is_a_wire_as_long_as_it_is_open() -> None:
    told = Told()
    with line_of_whole_frames(ports=2, baud=115_200) as line:
        server = busway.serve(f"rtu://{line.paths[1]}?baud=115200", units={1: busway.Device(holding_registers=1)})
        server.use_tap(told)
        async with server:
            (connection,) = told.open_connections
            assert (connection.framing, connection.carrier) == ("rtu", "serial")
            assert connection.listener == connection.peer == server.endpoints[0]
            assert connection.gap == pytest.approx(0.00175)
            connection.send(b"\x00\xff")
            await until(lambda: b"".join(talk.data for talk in line.transmissions() if talk.port == 1) == b"\x00\xff")
            await asyncio.sleep(3 * connection.gap)  # the silence that a master keeps before it asks
            line.inject(encode_rtu(1, READ))
            await until(lambda: encode_rtu(1, REPLY) in b"".join(one.data for one in line.transmissions()))
            spoken = b"".join(talk.data for talk in line.transmissions() if talk.port == 1)
            assert spoken == b"\x00\xff" + encode_rtu(1, REPLY)
            line.unplug(1)
            await until(lambda: told.gone == [connection])
            connection.send(b"the port is not there")
        assert told.gone == [connection]


async def test_server_without_a_tap_makes_no_taps_of_connections() -> None:
    async with busway.serve("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=1)}) as server:
        reader, writer = await _connected(server)
        writer.write(encode_mbap(1, 1, READ))
        assert await asyncio.wait_for(reader.readexactly(11), 60) == encode_mbap(1, 1, REPLY)
        with pytest.raises(busway.ConfigError, match="a running server keeps its connection tap"):
            server.use_tap(Told())
        writer.close()
        await writer.wait_closed()
