"""The program of the table `batches` publishes to a real server: the table would only say that it was not measured."""

from pathlib import Path

import pytest
from foreign_servers import nats_server

pytest.importorskip("nats")
pytest.importorskip("msgpack")

from clients.fleet_batches import SIZES, measured


async def test_messages_of_all_sizes_are_published_beside_bare_bytes(tmp_path: Path) -> None:
    with nats_server(tmp_path) as server:
        found = await measured(server.port, 0.01, 1)
    assert found.keys() == SIZES.keys()
    assert all(each["ours, s"] > 0 and each["ratio, CPU"] > 0 for each in found.values())
