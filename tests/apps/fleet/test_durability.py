"""What the NATS servers of a zone keep when they lose power is known by name, or said to be unknown."""

import json
from pathlib import Path

import pytest
from foreign_servers import ForeignServer, free_port, needed

from busway.apps.fleet.coordinators.nats import NatsCoordinator
from busway.apps.fleet.coordinators.opening import CoordinatorOptions, open_coordinator
from busway.apps.fleet.durability import (
    ServerDurability,
    decode_server,
    durability_warnings,
    server_durability,
)
from busway.cli.fleet_servers import write_server_files
from busway.errors import ConfigError


def answer(version: str, **config: object) -> bytes:
    return json.dumps({"server": {"name": "n1", "ver": version}, "data": {"config": config}}).encode()


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (answer("2.9.10", max_storage=1), ServerDurability("n1", "2.9.10", False)),
        (answer("2.10.4", sync_interval=120_000_000_000), ServerDurability("n1", "2.10.4", False)),
        (answer("2.10.4", sync_interval=120_000_000_000, sync_always=True), ServerDurability("n1", "2.10.4", True)),
        (answer("2.12.0-beta", sync_always=True), ServerDurability("n1", "2.12.0-beta", True)),
        (answer("new", sync_always=True), ServerDurability("n1", "new", None)),
        (b"no answer", None),
        (b"[]", None),
        (b'{"server": {}}', None),
    ],
)
def test_what_a_server_says_of_itself_is_whether_it_syncs(data: bytes, found: ServerDurability | None) -> None:
    assert decode_server(data) == found


def test_each_server_that_may_lose_what_it_acknowledged_is_named_and_so_is_a_table_on_too_few() -> None:
    old, new = ServerDurability("n1", "2.9.10", False), ServerDurability("n2", "2.10.4", True)
    unknown = ServerDurability("n3", "2.10.4", None)
    assert durability_warnings([new], 3, is_clustered=True) == []
    assert durability_warnings([old, new, unknown], 3, is_clustered=True) == [
        "nats-server n1 (2.9.10) acknowledges before it syncs to the disk; 3 servers have it, and it is "
        "lost if most of them lose power at once",
        "nats-server n3 (2.10.4) is not known to sync: --system-credentials FILE asks it; 3 servers have it, and it is "
        "lost if most of them lose power at once",
    ]
    (few,) = durability_warnings([new], 1, is_clustered=True)
    assert few.startswith("the table of the zone is on 1 of the servers of a cluster: where one is lost, no lease")
    (alone,) = durability_warnings([old], 1, is_clustered=False)
    assert alone.endswith("it alone has it, and it is lost if that loses power at once")


@pytest.mark.real_time
async def test_a_real_server_is_asked_by_the_user_of_its_system_account_and_by_no_other(tmp_path: Path) -> None:
    pytest.importorskip("nats")
    pytest.importorskip("nkeys")
    port = free_port()
    write_server_files("hall", str(tmp_path), f"127.0.0.1:{port}", "2.9", str(tmp_path / "js"), None, force=False)
    url, options = f"nats://127.0.0.1:{port}", CoordinatorOptions(credentials=str(tmp_path / "hall-operator.nk"))
    with ForeignServer([needed("nats-server"), "-c", str(tmp_path / "n1.conf")], port):
        table = await open_coordinator(url, "hall", options)
        try:
            assert isinstance(table, NatsCoordinator)
            (asked,) = await server_durability(table, url, options, str(tmp_path / "status.nk"))
            (connected,) = await server_durability(table, url, options, None)
            assert asked == connected
            assert (asked.name, asked.version.split(".")[0]) == ("n1", "2")
            with pytest.raises(ConfigError, match="is no user of the system account"):
                await server_durability(table, url, options, str(tmp_path / "hall-operator.nk"))
        finally:
            await table.close()
