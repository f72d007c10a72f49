"""The program of the table `batches` publishes to a real server: the table would only say that it was not measured."""

from pathlib import Path

import pytest
from foreign_servers import nats_server

pytest.importorskip("nats")
pytest.importorskip("msgpack")

from clients.fleet_batches import SIZES, measured, message

from busway.apps.fleet.messages import MOST_BYTES, longest_head, longest_row


async def test_messages_of_all_sizes_are_published_beside_bare_bytes(tmp_path: Path) -> None:
    with nats_server(tmp_path) as server:
        found = await measured(server.port, 0.01, 1)
    assert found.keys() == SIZES.keys()
    for size, each in found.items():
        assert each["ours, s"] > 0
        assert each["ratio, CPU"] > 0
        assert each["bytes"] == pytest.approx(1000 * int(size.removesuffix(" kB")), rel=0.1)
        assert each["bytes"] <= MOST_BYTES


def longest(samples: int) -> int:
    """How long a message can become at most, as an outbox computes it before."""
    made, known = message(samples, 1), set[str]()
    head = longest_head(made.collector, made.store, made.link)
    return head + sum(longest_row(row, known) for row in made.samples)


def test_an_outbox_would_send_the_messages_and_none_larger_than_the_largest() -> None:
    most = max(SIZES.values())
    assert longest(most) <= MOST_BYTES < longest(most + 1)
