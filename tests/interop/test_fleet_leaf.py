"""An edge site on real nats-servers by generated files: a cut to the centre is a backlog there, and no loss."""

import asyncio
import contextlib
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from foreign_servers import ForeignServer, free_port, needed

from busway.apps.collector.cancellation import end_tasks
from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.fleet.coordinators.nats import NatsCoordinator, find_bucket
from busway.apps.fleet.coordinators.opening import CoordinatorOptions, open_coordinator
from busway.apps.fleet.streams import SinkLag, StreamOptions, StreamSink, make_audit_stream, make_stream, sink_lags
from busway.cli.fleet_servers import write_server_files

pytest.importorskip("nats")
pytest.importorskip("nkeys")
pytest.importorskip("msgpack")
pytestmark = pytest.mark.real_time


class NoSink:
    """Takes what comes."""

    async def open(self) -> None:
        pass

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        pass

    async def close(self) -> None:
        pass


async def names_in(client: Any, stream: str) -> list[str]:
    """The identities of all messages of a stream, in its order."""
    jetstream = client.jetstream(timeout=10)
    state = (await jetstream.stream_info(stream)).state
    found = []
    for sequence in range(state.first_seq or 1, state.last_seq + 1):
        message = await jetstream.get_msg(stream, sequence)
        found.append((message.headers or {})["Nats-Msg-Id"])
    return found


async def test_an_edge_site_stores_while_it_is_cut_off_and_the_centre_has_every_message_once_after_that(
    tmp_path: Path,
) -> None:
    centre_port, edge_port = free_port(), free_port()
    write_server_files(
        "hall", str(tmp_path), f"127.0.0.1:{centre_port}", "2.9", str(tmp_path / "js"), None,
        force=False, sites=f"yard=127.0.0.1:{edge_port}",
    )  # fmt: skip
    program = needed("nats-server")
    centre = ForeignServer([program, "-c", str(tmp_path / "n1.conf")], centre_port)
    edge = ForeignServer([program, "-c", str(tmp_path / "yard.conf")], edge_port)

    async def opened(stack: contextlib.AsyncExitStack, port: int, role: str, domain: str | None) -> NatsCoordinator:
        options = CoordinatorOptions(credentials=str(tmp_path / f"yard-{role}.nk"), domain=domain)
        table = await open_coordinator(f"nats://127.0.0.1:{port}", "yard", options)
        stack.push_async_callback(table.close)
        assert isinstance(table, NatsCoordinator)
        return table

    async with contextlib.AsyncExitStack() as stack:
        stack.enter_context(centre)
        stack.enter_context(edge)
        there = await opened(stack, edge_port, "operator", None)
        far = await opened(stack, centre_port, "operator", "yard")
        await far.create("control.configuration", b"from the centre")
        await find_bucket(far.client, "busway-yard-commands", CoordinatorOptions(domain="yard"))
        await make_audit_stream(far.client, "yard", 1, domain="yard")
        await make_stream(far.client, "yard", StreamOptions(source="yard"))
        collector = await opened(stack, edge_port, "collector", None)
        sent: list[str] = []

        async def send(count: int) -> None:
            for _ in range(count):
                name = f"m{len(sent)}"
                ours = collector.client.jetstream(timeout=10)
                await ours.publish("busway.yard.samples.0001", b"not read", headers={"Nats-Msg-Id": name})
                sent.append(name)

        reading = await opened(stack, centre_port, "sink", "yard")
        sink = StreamSink(reading.client, reading, "yard", "broker", NoSink())
        task = asyncio.create_task(sink.run())
        stack.push_async_callback(end_tasks, [task])

        async def until_taken(count: int) -> None:
            """Wait until collectors of the site see that the sink at the centre has so many messages."""
            async with asyncio.timeout(90), contextlib.aclosing(there.watch("cursor.")) as entries:
                async for entry in entries:
                    if entry.key == "cursor.broker" and json.loads(entry.value)[0] == count:
                        return

        await send(20)
        await until_taken(20)
        centre.stop()
        await send(30)  # acknowledged by the edge site alone
        assert await names_in(there.client, "busway-samples-yard") == sent
        centre.start()
        await until_taken(50)
        assert await names_in(far.client, "busway-samples-yard") == sent, "every message, in order, none twice"
        await send(5)
        await until_taken(55)
        assert (await sink_lags(far.client, far, "yard"))["broker"] == SinkLag(0, 0.0)
        await end_tasks([task])
        await send(3)
        while True:
            lag = (await sink_lags(far.client, far, "yard", lambda: time.time() + 100))["broker"]
            if lag.messages == 3:
                break
            await asyncio.sleep(0.05)
        assert lag.seconds is not None
        assert lag.seconds >= 100, "the age of the oldest that it has not taken"
        assert (await sink_lags(reading.client, reading, "yard"))["broker"] == SinkLag(3, None), "not for the sink"
        assert await names_in(far.client, "busway-samples-yard") == sent
