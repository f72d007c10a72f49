"""Pages for Prometheus that a newer configuration wants: all of them are there, or no port stays bound."""

from pathlib import Path

import pytest
from collected import NOON
from fleet_devices import FleetDevice, plant

from busway.apps.collector.configuration import CollectorConfiguration, parse_collector
from busway.apps.collector.connected_systems import ConnectedSystems
from busway.apps.collector.store.writer import StoreWriter
from busway.config.files.sinks import PrometheusSinkSection
from busway.errors import ConfigError, LinkDown, MissingExtra, ModbusError

PAGE = """
[[sink]]
name = "{name}"
url = "prometheus://127.0.0.1:{port}"
points = ["*/*"]
"""


class FakePage:
    """A page that listens nowhere."""

    def __init__(self, section: PrometheusSinkSection) -> None:
        self.url, self.is_open = section.url, True

    def close(self) -> None:
        self.is_open = False


def with_pages(folder: Path, names: str) -> CollectorConfiguration:
    pages = "".join(PAGE.format(name=name, port=9000 + at) for at, name in enumerate(names))
    return parse_collector(plant(folder / "store", [FleetDevice("meter", 502)]) + pages, "x.toml")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MissingExtra("prometheus_client", "metrics", purpose="a page"), "prometheus_client"),
        (ConfigError("names no point", key="points"), "names no point"),
        (LinkDown("the port is in use", kind="other"), "the port is in use"),
    ],
    ids=["missing", "wrong", "taken"],
)
@pytest.mark.parametrize("way", ["prepare", "check"])
def test_no_page_stays_open_where_a_later_one_cannot_be_made(
    tmp_path: Path, error: ModbusError, said: str, way: str
) -> None:
    made: list[FakePage] = []

    def page(section: PrometheusSinkSection) -> FakePage:
        if len(made) == 2:
            raise error
        made.append(FakePage(section))
        return made[-1]

    systems = ConnectedSystems(page, lambda *_: pytest.fail("no commands"))  # type: ignore[arg-type]
    writer = StoreWriter(tmp_path / "store", now=NOON)
    try:
        systems.begin(writer, with_pages(tmp_path, ""))
        with pytest.raises(ConfigError, match=said):
            getattr(systems, way)(with_pages(tmp_path, "abc"))
        assert [each.is_open for each in made] == [False, False]
    finally:
        systems.close_sinks()
        writer.close(NOON)
