"""The serial guide: its code runs, every option is spelled out, warnings and figures of the document are there."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from busway.options.declaration import declared
from busway.options.lines import BreakerParameters, FramingParameters, SerialClientParameters
from busway.options.ports import OpeningParameters, SerialSettings

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "serial.md"
CLASSES = (SerialSettings, OpeningParameters, FramingParameters, SerialClientParameters, BreakerParameters)


@pytest.fixture(scope="module")
def text() -> str:
    return GUIDE.read_text(encoding="utf-8")


@pytest.mark.clause("S20")
def test_its_example_runs_and_prints_what_it_says(run_page: Callable[[Path], None]) -> None:
    run_page(GUIDE)


@pytest.mark.clause("S20")
@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_every_option_is_spelled_out(text: str, kind: type) -> None:
    explained = set(re.findall(r"`(\w+)`", "\n".join(re.findall(r"^\| (`.+?) \|", text, re.MULTILINE))))
    assert [name for name in declared(kind) if name not in explained] == []


@pytest.mark.clause("S20")
@pytest.mark.parametrize(
    "heading",
    [
        "What is needed",
        "Quick start",
        "Operating modes",
        "Visual diagnosis",
        "Registers and functions",
        "What each option is for",
        "2-wire RS-485",
        "4-wire RS-485",
        "RS-232",
        "Polarisation",
        "Cable, shield, ground",
        "Warnings",
    ],
)
def test_what_the_document_asks_of_a_user_guide_is_there(text: str, heading: str) -> None:
    assert re.search(rf"^#+ {re.escape(heading)}$", text, re.MULTILINE)


@pytest.mark.clause("S20")
@pytest.mark.parametrize(
    "warning",
    ["Two devices must never have the same address", "A crossed cable on a 2-wire system can do damage"],
)
def test_the_important_warnings_stand_out(text: str, warning: str) -> None:
    assert f"> **{warning}" in text


@pytest.mark.clause("S22")
@pytest.mark.parametrize(
    "figure",
    [
        "150 Ω, 0.5 W",  # termination, §3.4.5
        "1 nF (10 V at least) in series with 120 Ω (0.25 W)",
        "450 to 650 Ω",  # polarisation, §3.4.6
        "four devices fewer",
        "32 are always allowed, 28 on a polarised line",  # §3.4.1
        "1000 m at 9600 baud with AWG 26",  # lengths, §3.4.3
        "40 m divided by",
        "600 m with category 5",  # cables, §3.6
        "| 4 | 5 | **D1**, required | TXD1, required |",  # pins, §3.5
        "| 5 | 9 | **D0**, required | TXD0, required |",
        "| 8 | 1 | **Common**, required | Common, required |",
        "| 1 | 8 | | RXD0, required |",
        "| 2 | 4 | | RXD1, required |",
        "| D1, TXD1 | yellow |",  # colours, §3.6
        "| D0, TXD0 | brown |",
        "| Common | grey |",
        "| RXD0 (4-wire) | white |",
        "| RXD1 (4-wire) | blue |",
        "at most 2500 pF",  # RS-232, §3.3.5
    ],
)
def test_the_figures_of_chapter_3_are_there(text: str, figure: str) -> None:
    assert figure in text
