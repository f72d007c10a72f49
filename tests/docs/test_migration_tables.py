"""The calls that migration pages name as those of busway: each runs against the device of its page."""

import asyncio
from pathlib import Path

from migration_tables import awaited, called, calls_of, device_of

from busway.client.settings import link_settings

ROOT = Path(__file__).resolve().parents[2]


def test_the_calls_of_a_blocking_client_run() -> None:
    name = "migrate-from-pymodbustcp.md"
    ours = [call for _, call in calls_of(name)]
    with device_of(name) as endpoint:
        results = called(ours, endpoint)
    assert dict(zip(ours, results, strict=True))['[unit.read("3x1", "float32")]'] == [21.5]
    assert [result is None for result in results] == [call.startswith("unit.write") for call in ours]


def test_the_calls_of_an_asyncio_client_run() -> None:
    name = "migrate-from-tmodbus.md"
    ours = [call for _, call in calls_of(name)]
    with device_of(name) as endpoint:
        results = asyncio.run(awaited(ours, endpoint))
    named = dict(zip(ours, results, strict=True))
    assert named['await unit.read("4x51", "float32")'] == 21.5
    assert named['await unit.read("4x61", "string:8")'] == "pump"
    writes = ("await unit.write", "await unit.mask")
    assert [result is None for result in results] == [call.startswith(writes) for call in ours]


def test_the_timeout_of_a_page_is_the_one_of_a_link_over_tcp() -> None:
    page = (ROOT / "docs" / "how-to" / "migrate-from-pymodbustcp.md").read_text(encoding="utf-8")
    assert f"`timeout=30.0`; {link_settings('tcp://10.0.0.5', {}).parameters.timeout:g} s if left out" in page
