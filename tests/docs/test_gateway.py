"""The page on the gateway: its code runs, its files are right, its tables say what the code says."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from generated import assert_up_to_date

from busway.apps.gateway.configuration import parse_gateway
from busway.apps.gateway.overview import ROUTING_HEADINGS, gateway_rows, routing_rows
from busway.config.files.gateway import GatewayListenerSection, GatewaySection, RouteSection, UpstreamSection
from busway.config.files.listeners import ListenerSection
from busway.config.files.system import LinkKeys

ROOT = Path(__file__).resolve().parents[2]
GUIDE = ROOT / "docs" / "gateway.md"
REFERENCE = ROOT / "docs" / "reference" / "defaults.md"
SETUPS = (
    "One serial line for many masters",
    "An inverter that takes one connection",
    "A read-only view for a third party",
    "A serial master that reads servers on a network",
    "Merging lines by renumbering",
)


@pytest.fixture(scope="module")
def text() -> str:
    return GUIDE.read_text(encoding="utf-8")


def files_of(text: str) -> list[str]:
    """The gateway files of the page."""
    return re.findall(r"^```toml\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


@pytest.mark.clause("T32")
def test_its_program_runs_and_prints_what_it_says(run_page: Callable[[Path], None]) -> None:
    run_page(GUIDE)


def test_its_files_are_right_and_nothing_in_them_is_odd(text: str) -> None:
    files = files_of(text)
    assert len(files) == 1 + len(SETUPS)
    for number, file in enumerate(files):
        configuration = parse_gateway(file, f"{number}.toml")
        assert configuration.warnings == ()


@pytest.mark.parametrize("heading", SETUPS)
def test_the_five_set_ups_are_there(text: str, heading: str) -> None:
    assert f"\n### {heading}\n" in text


def test_what_check_prints_is_what_it_prints(text: str) -> None:
    configuration = parse_gateway(files_of(text)[0], "plant.toml")
    for rows in (list(gateway_rows(configuration)), [ROUTING_HEADINGS, *routing_rows(configuration)]):
        widths = [max(len(row[at]) for row in rows) for at in range(len(rows[0]))]
        for row in rows:
            line = "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            assert f"\n{line}\n" in text


def test_every_key_of_listeners_links_and_routes_is_named_and_explained_in_the_reference(text: str) -> None:
    named = set(re.findall(r"`(\w+)`", text[text.index("### `[[listener]]`") : text.index("## What the client gets")]))
    explained = set(re.findall(r"^\| `(\w+)` \|", REFERENCE.read_text(encoding="utf-8"), re.MULTILINE))
    own = (
        set(GatewayListenerSection.model_fields) - set(ListenerSection.model_fields),
        set(UpstreamSection.model_fields) - set(LinkKeys.model_fields) - {"name", "url", "same_device"},
        set(RouteSection.model_fields),
        set(GatewaySection.model_fields),
    )
    for keys in own:
        assert keys - explained == set()
        assert keys - named == set()
    assert {"url", "name", "same_device"} <= named


def test_the_tables_of_registers_are_those_of_the_map() -> None:
    assert_up_to_date("gateway_registers.py")
