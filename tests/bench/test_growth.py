"""Rows of growth measure what they say: each peer is answered, no connection is closed, each point is there."""

import asyncio
from contextlib import AsyncExitStack, closing
from pathlib import Path

import pytest
from offline import growth, growth_of_points, growth_of_stores
from offline.wire import MemoryLoop


def test_each_peer_over_udp_has_an_answer_for_each_of_its_requests() -> None:
    loop = MemoryLoop()
    running = AsyncExitStack()
    step = loop.run_until_complete(running.enter_async_context(growth.udp_peers(loop, 64)))
    ((transport, _),) = loop.datagram_listeners.values()
    transport.sent.clear()
    step()
    each = growth.READS // 64 * (9 + 2 * growth.REGISTERS)
    assert transport.sent == {("127.0.0.1", 40_000 + number): each for number in range(64)}
    loop.run_until_complete(running.aclose())
    loop.close()


@pytest.mark.parametrize("setting", ["connections", "mixed_connections", "rtu_connections"])
def test_no_connection_of_a_row_is_closed_to_make_room_for_the_next(
    setting: str, caplog: pytest.LogCaptureFixture
) -> None:
    loop = MemoryLoop()
    asyncio.set_event_loop(loop)
    running = AsyncExitStack()
    loop.run_until_complete(running.enter_async_context(getattr(growth, setting)(loop, 100)))()
    assert "to make room" not in caplog.text
    loop.run_until_complete(running.aclose())
    asyncio.set_event_loop(None)
    loop.close()


def test_message_has_as_many_points_as_the_row_says() -> None:
    for points in growth_of_points.MESSAGE_POINTS:
        rows = growth_of_points.message(growth_of_points.MESSAGE, points).samples
        assert len(rows) == growth_of_points.MESSAGE
        assert len({(row.device, row.point) for row in rows}) == points


def test_store_of_a_row_has_as_many_points_as_the_row_says(tmp_path: Path) -> None:
    with closing(growth_of_stores.Growing(tmp_path, 500, 1000)) as growing:
        assert growing.writer.manifest.count_points() == 500
