"""The part of the simulator's page on faults: its table is that of the code and has every known fault profile."""

import tomllib
from pathlib import Path

from field_faults import OF_SERVERS, PLAYED_ELSEWHERE
from generated import assert_up_to_date

from busway.apps.simulator.added_faults import fault_problems
from busway.config.files.fault_sections import FaultSection
from busway.config.files.section import Section
from busway.config.files.toml_source import read_source
from busway.faults.profiles.not_simulated import NOT_SIMULATED
from busway.testing import CLIENT_FAULT_PROFILES, FAULT_PROFILES

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "simulator.md"

OF_THE_FIELD = (*OF_SERVERS, *PLAYED_ELSEWHERE)


def test_the_table_of_fault_profiles_is_that_of_the_code() -> None:
    assert_up_to_date("fault_profiles_table.py")


def test_every_known_fault_profile_can_be_played_or_says_who_plays_it() -> None:
    assert sorted(OF_THE_FIELD) == sorted([*FAULT_PROFILES, *NOT_SIMULATED])
    assert set(CLIENT_FAULT_PROFILES) <= set(NOT_SIMULATED)
    text = PAGE.read_text(encoding="utf-8")
    assert [name for name in OF_THE_FIELD if f"| `{name}` |" not in text] == []
    for one in NOT_SIMULATED.values():
        assert one.happens
        assert one.answer
        assert one.played_by


class _File(Section):
    fault: list[FaultSection]


def test_the_section_that_is_shown_can_be_read() -> None:
    text = PAGE.read_text(encoding="utf-8")
    (shown,) = [part.split("```")[0] for part in text.split("```toml\n")[1:] if "[[fault]]" in part]
    assert tomllib.loads(shown)["fault"]
    source = read_source(shown, "shown.toml")
    assert fault_problems(source.checked(_File).fault, source) == []
