"""What the primary host and others say to a Sparkplug sink: nonsense is told and ends nothing."""

import asyncio
import logging
from types import SimpleNamespace

import pytest
from waiting import until

from busway.apps.collector.sinks.interface import SinkDown
from busway.apps.collector.sinks.sparkplug import SparkplugSink

pytest.importorskip("aiomqtt")
pytest.importorskip("google.protobuf")


def sink() -> SparkplugSink:
    return SparkplugSink("broker", group="plant", edge_node="hall", primary_host="scada")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"\xff",
        b'{"online": true}',
        b'{"online": true, "timestamp": "soon"}',
        b'{"online": true, "timestamp": Infinity}',
        b'{"online": true, "timestamp": NaN}',
        b"[" * 100_000,
    ],
)
async def test_a_state_that_is_none_is_told_and_changes_nothing(
    content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    made = sink()
    made._take_state(content)
    assert not made._host_online.is_set()
    assert "scada says a state that is none" in caplog.text
    made._take_state(b'{"online": true, "timestamp": 5}')
    assert made._host_online.is_set()


async def test_a_sink_that_no_longer_hears_its_host_is_down_and_the_log_says_why(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.ERROR)

    class Client:
        _client = SimpleNamespace(on_connect=None, on_publish=None, on_disconnect=None)  # paho's

        def __init__(self, **options: object) -> None: ...
        async def __aenter__(self) -> None: ...
        async def __aexit__(self, *exception: object) -> None: ...
        async def subscribe(self, *arguments: object, **options: object) -> None: ...
        async def publish(self, *arguments: object, **options: object) -> None: ...

        @property
        def messages(self) -> object:
            raise ZeroDivisionError("of the test")

    monkeypatch.setattr("aiomqtt.Client", Client)
    made = SparkplugSink("broker", group="plant", edge_node="hall")
    await made.open()
    await asyncio.sleep(0)
    with pytest.raises(SinkDown, match="no longer received"):
        await made.send([])
    await made.close()
    await until(lambda: "messages are no longer received" in caplog.text)
