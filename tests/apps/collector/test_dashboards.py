"""Dashboards for Grafana: what they ask is answered by the servers that they are for."""

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from collected import at, meter_read
from deliveries import delivery_to, run_until
from foreign_servers import PostgresqlServer, victoria_metrics

from busway.apps.collector.dashboards import KINDS, dashboard
from busway.apps.collector.sinks.prometheus import LastValues, PrometheusPage
from busway.apps.collector.store.writer import Commit, StoreWriter
from busway.errors import ConfigError

MACROS = {
    "$__timeFilter(time)": "time BETWEEN to_timestamp(0) AND to_timestamp(4e9)",
    "$__timeGroupAlias(time, $__interval)": "date_bin('10 seconds', time, to_timestamp(0)) AS time",
    "${device:sqlstring}": "'meter-7'",
    "${point:sqlstring}": "'voltage','current'",
}
"""What Grafana puts in their place."""


def questions(kind: str, key: str) -> dict[str, str]:
    """What each panel asks, by its title."""
    found = json.loads(dashboard(kind))
    return {panel["title"]: target[key] for panel in found["panels"] for target in panel["targets"]}


@pytest.mark.parametrize("kind", KINDS)
def test_a_dashboard_can_be_imported_into_any_grafana(kind: str) -> None:
    found = json.loads(dashboard(kind))
    (wanted,) = found["__inputs"]
    sources = [panel["datasource"] for panel in found["panels"]] + [
        one["datasource"] for one in found["templating"]["list"]
    ]
    assert {source["uid"] for source in sources} == {"${" + wanted["name"] + "}"}
    assert {source["type"] for source in sources} == {wanted["pluginId"]}
    assert len({panel["id"] for panel in found["panels"]}) == len(found["panels"])
    assert "id" not in found


def test_there_is_none_of_another_kind() -> None:
    with pytest.raises(ConfigError, match="dashboards for prometheus and postgresql, not for 'influx'"):
        dashboard("influx")


@pytest.fixture
def database() -> Iterator[PostgresqlServer]:
    with PostgresqlServer() as server:
        yield server


async def test_each_panel_for_postgresql_is_answered(tmp_path: Path, database: PostgresqlServer) -> None:
    pg = pytest.importorskip("asyncpg")
    from busway.apps.collector.sinks.postgresql import PostgresqlSink

    with StoreWriter(tmp_path, now=at(0)) as writer:
        for number in range(5):
            writer.commit([meter_read(number, number)], [], at(number))
        delivery = delivery_to(PostgresqlSink(database.url, password=database.PASSWORD), writer)
        await run_until(delivery, lambda: delivery.status().sent == 15)
    connection = await pg.connect(database.url, password=database.PASSWORD)
    try:
        rows: dict[str, list[Any]] = {}
        variables = {one["name"]: one["query"] for one in json.loads(dashboard("postgresql"))["templating"]["list"]}
        for title, statement in {**questions("postgresql", "rawSql"), **variables}.items():
            for macro, text in MACROS.items():
                statement = statement.replace(macro, text)
            assert "$" not in statement
            rows[title] = [tuple(row) for row in await connection.fetch(statement)]
    finally:
        await connection.close()
    assert rows["device"] == [("meter-7",)]
    assert [row[1:] for row in rows["Values"]] == [("meter-7 current", 2.0), ("meter-7 voltage", 232.0)]
    assert [row[1:] for row in rows["Least and greatest"]] == [
        ("meter-7 current", 0.0, 4.0),
        ("meter-7 voltage", 230.0, 234.0),
    ]
    assert [(row[1], row[3], row[5]) for row in rows["Last samples"]] == [
        ("current", 4.0, "good"),
        ("voltage", 234.0, "good"),
    ]
    assert rows["Bad samples"] == []


async def test_each_panel_for_prometheus_is_answered(tmp_path: Path) -> None:
    httpx = pytest.importorskip("httpx")
    pytest.importorskip("prometheus_client")
    with victoria_metrics(tmp_path) as server:
        values = LastValues()
        page = PrometheusPage("127.0.0.1:0", ["meter-7/*"], values)
        async with httpx.AsyncClient(trust_env=False, base_url=f"http://127.0.0.1:{server.port}") as client:
            try:
                now = time.time_ns()
                values.update(Commit(1, now, [meter_read((now - at(0)) / 10**9, 5)], []))
                text = (await client.get(page.url)).text
            finally:
                page.close()
            for age in (30, 20, 10, 0):
                moment = {"timestamp": str(now // 10**6 - age * 1000)}
                (await client.post("/api/v1/import/prometheus", params=moment, content=text)).raise_for_status()

            async def answer(expression: str) -> list[Any]:
                asked = {"query": expression, "nocache": "1", "latency_offset": "1ms"}
                found = (await client.get("/api/v1/query", params=asked)).json()
                assert found["status"] == "success", (expression, found)
                result: list[Any] = found["data"]["result"]
                return result

            await client.get("/internal/force_flush")  # what was sent can be asked for from now on
            for title, expression in questions("prometheus", "expr").items():
                expression = expression.replace("$device", ".*").replace("$point", ".+")
                assert "$" not in expression
                found = await answer(expression)
                assert len(found) == (1 if title == "Points with a value" else 2), title
                assert set(re.findall(r"busway_\w+", expression)) <= set(re.findall(r"busway_\w+", text))
