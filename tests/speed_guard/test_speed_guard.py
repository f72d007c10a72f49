"""What one transaction takes, counted in calls, instructions and bytes, has not changed by more than a tenth.

The figures do not depend on what else the machine does. A change that is meant: run scripts/speed_guard.py, look at the
difference, and commit the file with the change.
"""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture(scope="module")
def guard() -> ModuleType:
    """scripts/speed_guard.py, which is no module of a package."""
    found = importlib.util.spec_from_file_location("speed_guard", SCRIPTS / "speed_guard.py")
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    sys.path.insert(0, str(SCRIPTS))
    try:
        found.loader.exec_module(module)
    finally:
        sys.path.remove(str(SCRIPTS))
    return module


def test_work_of_a_transaction_is_within_a_tenth_of_the_committed_figures(guard: ModuleType) -> None:
    kept = guard.kept()
    version = "{}.{}".format(*sys.version_info[:2])
    found = guard.counted(sys.executable)
    if version in kept:
        assert guard.differences(found, kept[version]) == []
    else:  # a Python that the file does not know: its instructions are others, its calls hardly
        assert guard.differences(found, kept[max(kept)], ("calls",)) == []


def test_figures_are_kept_for_every_version_that_is_tested(guard: ModuleType) -> None:
    assert set(guard.kept()) >= {"3.11", "3.12", "3.13"}


def test_figure_that_is_off_by_more_than_a_tenth_is_named_whichever_way(guard: ModuleType) -> None:
    expected = {"server": {"calls": 10.0, "instructions": 100.0, "bytes": 50.0}}
    found = {"server": {"calls": 11.1, "instructions": 109.0, "bytes": 44.0}}
    assert guard.differences(found, expected) == [
        "server: 11.1 calls per transaction, +11 %",
        "server: 44.0 bytes per transaction, -12 %",
    ]


def test_script_without_figures_and_figures_without_script_are_named(guard: ModuleType) -> None:
    work = {"calls": 1.0, "instructions": 1.0, "bytes": 1.0}
    assert guard.differences({"new": work}, {"old": work}) == [
        "new: it has no figures yet",
        "old: there is no such script any more",
    ]
    assert guard.differences({"same": work}, {"same": work}) == []


def test_file_is_what_the_script_writes(guard: ModuleType) -> None:
    assert guard.FILE.read_text(encoding="utf-8") == guard.text(guard.kept())


@pytest.mark.parametrize("arguments", [["--help"], ["--chekc"]])
def test_file_is_not_written_by_who_asks_for_help_or_mistypes_an_option(
    guard: ModuleType, arguments: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(guard, "FILE", tmp_path / "figures.toml")
    monkeypatch.setattr(guard, "interpreters", dict)
    monkeypatch.setattr(sys, "argv", ["speed_guard.py", *arguments])
    with pytest.raises(SystemExit):
        guard.main()
    assert not guard.FILE.exists()
