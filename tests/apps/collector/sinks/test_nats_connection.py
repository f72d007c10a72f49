"""Clients of NATS that are to encrypt, and a server that offers no TLS: nothing is sent to it."""

import asyncio
import contextlib
from collections.abc import AsyncIterator

import pytest
from waiting import until

from busway.apps.collector.commands.command_messages import InputRights
from busway.apps.collector.commands.nats import NatsCommands
from busway.apps.collector.sinks.interface import SinkDown
from busway.apps.collector.sinks.nats import NatsSink
from busway.apps.collector.sinks.options import tls_context
from busway.apps.fleet.coordinator import CoordinatorDown
from busway.apps.fleet.coordinators.nats import connect_nats
from busway.apps.fleet.coordinators.opening import CoordinatorOptions

pytest.importorskip("nats")
INFO = b'INFO {"server_id":"x","version":"2.10.0","headers":true,"auth_required":true,"max_payload":1000000}\r\n'
OFFERS = "it offers no TLS, which the URL asks for; nothing was sent"


class Listening:
    """A server without TLS, or what stands between and hides that there is TLS; it keeps what it is sent."""

    def __init__(self) -> None:
        self.port = 0
        self.connections = 0
        self.heard = b""

    async def answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        writer.write(INFO)
        with contextlib.suppress(OSError):
            while line := await reader.readline():
                self.heard += line
                if line.startswith(b"PING"):
                    writer.write(b"PONG\r\n")
        writer.close()


@contextlib.asynccontextmanager
async def listening() -> AsyncIterator[Listening]:
    found = Listening()
    server = await asyncio.start_server(found.answer, "127.0.0.1", 0)
    found.port = server.sockets[0].getsockname()[1]
    async with server:
        yield found
    assert found.connections >= 1
    assert found.heard == b""


@pytest.mark.parametrize("has_context", [True, False])
async def test_a_sink_sends_no_password_without_the_tls_that_its_url_asks_for(has_context: bool) -> None:
    async with listening() as server:
        tls = tls_context() if has_context else None
        url = f"tls://127.0.0.1:{server.port}"
        sink = NatsSink(url, user="collector", password="geheim", tls=tls, timeout=10.0)
        with pytest.raises(SinkDown, match=OFFERS):
            await sink.open()
        await sink.close()


async def test_an_input_of_commands_sends_no_token_without_the_tls_that_its_url_asks_for() -> None:
    class Receiver:
        said = ""

        def down(self, error: str) -> None:
            self.said = error

    async with listening() as server:
        rights = InputRights("plant.{device}.{point}.set", ("*",))
        commands = NatsCommands(f"tls://127.0.0.1:{server.port}", rights, token="geheim", tls=tls_context())
        receiver = Receiver()
        running = asyncio.create_task(commands.run(receiver))  # type: ignore[arg-type]
        await until(lambda: receiver.said != "")
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        assert OFFERS in receiver.said


async def test_a_fleet_sends_no_password_without_the_tls_that_its_url_asks_for() -> None:
    async with listening() as server:
        options = CoordinatorOptions(user="collector", password="geheim", answer=0.3)
        with pytest.raises(CoordinatorDown, match=OFFERS):
            await connect_nats(f"tls://127.0.0.1:{server.port}", options)
