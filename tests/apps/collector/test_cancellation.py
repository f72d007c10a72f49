"""Tasks of libraries that swallow a cancellation end all the same."""

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from collected import filled
from deliveries import RecordingSink, delivery_to

from busway.apps.collector.cancellation import end_if_cancelled, end_tasks
from busway.apps.collector.commands import mqtt, nats
from busway.apps.collector.commands.command_messages import InputRights
from busway.apps.collector.sinks.interface import SinkDown
from busway.apps.collector.store.committed_samples import CommittedSample

LIMIT = 20.0
RIGHTS = InputRights("plant.{device}.{point}.set", ("*/*",))


async def swallowing(begun: asyncio.Event) -> None:
    """Wait until the cancellation, and swallow it, as `asyncio.wait_for` of Python 3.11 can."""
    begun.set()
    try:
        await asyncio.Event().wait()
    except asyncio.CancelledError:
        return


async def ends(task: "asyncio.Task[None]", begun: asyncio.Event) -> bool:
    """Whether a task ends after it was cancelled once."""
    await asyncio.wait_for(begun.wait(), LIMIT)
    task.cancel()
    done, _ = await asyncio.wait([task], timeout=LIMIT)
    return task in done


async def test_a_task_that_swallows_its_cancellation_is_cancelled_again() -> None:
    begun = asyncio.Event()

    async def stubborn() -> None:
        await swallowing(begun)
        await asyncio.Event().wait()

    task = asyncio.create_task(stubborn())
    await begun.wait()
    async with asyncio.timeout(LIMIT):
        await end_tasks([task], again=0.01)
    assert task.cancelled()


async def test_a_cancellation_that_was_swallowed_is_raised_when_it_is_looked_for() -> None:
    begun = asyncio.Event()

    async def looks() -> None:
        end_if_cancelled()  # not yet
        await swallowing(begun)
        end_if_cancelled()

    assert await ends(asyncio.create_task(looks()), begun)


@pytest.mark.parametrize("fails", [True, False])
async def test_a_delivery_ends_although_its_sink_swallows_the_cancellation(tmp_path: Path, fails: bool) -> None:
    begun = asyncio.Event()

    class Swallowing(RecordingSink):
        async def send(self, samples: Sequence[CommittedSample]) -> None:
            await swallowing(begun)
            if fails:
                raise SinkDown("no answer")

    with filled(tmp_path / "store", 1) as writer:
        assert await ends(asyncio.create_task(delivery_to(Swallowing(), writer).run()), begun)


class Handler:
    """The connection status of an input."""

    def connected(self) -> None:
        pass

    def down(self, error: str) -> None:
        pass


@pytest.mark.parametrize("fails", [True, False])
async def test_commands_over_nats_end_although_the_library_swallows_the_cancellation(
    monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    pytest.importorskip("nats")
    begun = asyncio.Event()

    class Client:
        is_connecting = is_connected = must_encrypt = False

        async def connect(self, *_: Any, **__: Any) -> None:
            await swallowing(begun)
            if fails:
                raise OSError("refused")

        async def subscribe(self, *_: Any, **__: Any) -> None:
            pass

        async def flush(self) -> None:
            pass

    monkeypatch.setattr(nats, "nats_client_kind", lambda: Client)
    made = nats.NatsCommands("nats://127.0.0.1:1", RIGHTS)
    assert await ends(asyncio.create_task(made.run(Handler())), begun)  # type: ignore[arg-type]


async def test_commands_over_mqtt_end_although_the_library_swallows_the_cancellation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("aiomqtt")
    begun = asyncio.Event()

    async def refused(_: Any) -> None:
        await swallowing(begun)
        raise OSError("refused")

    monkeypatch.setattr(mqtt, "connect", refused)
    made = mqtt.MqttCommands("127.0.0.1", 1, InputRights("plant/{device}/{point}/set", ("*/*",)))
    assert await ends(asyncio.create_task(made.run(Handler())), begun)  # type: ignore[arg-type]
