"""The file of kept values: whole or as it was, and put aside where it means nothing."""

from pathlib import Path

import pytest

from busway.errors import ConfigError
from busway.simulator.state import KeptPoint, KeptState, load_state, save_state

STATE = KeptState(
    12.5,
    {
        "1/a": KeptPoint(5, True),
        "1/b": KeptPoint(behaviour=0.1 + 0.2),
        "1/text": KeptPoint("Größe"),
        "1/bits": KeptPoint((True,) * 16),
        "1/nothing": KeptPoint(float("inf")),
    },
)


def test_what_was_saved_is_loaded_to_the_last_digit(tmp_path: Path) -> None:
    path = str(tmp_path / "state.json")
    assert load_state(path) is None
    save_state(path, STATE)
    save_state(path, STATE)
    assert load_state(path) == STATE
    assert [each.name for each in tmp_path.iterdir()] == ["state.json"]


def test_what_can_not_be_written_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = str(tmp_path / "state.json")
    save_state(path, STATE)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(ConfigError, match="No space left"):
        save_state(path, KeptState(99.0))
    assert load_state(path) == STATE
    assert [each.name for each in tmp_path.iterdir()] == ["state.json"]


def test_half_a_file_is_put_aside_and_said(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    save_state(str(path), STATE)
    half = path.read_bytes()[:100]
    path.write_bytes(half)
    with pytest.raises(ConfigError, match="can not be understood, and stand in"):
        load_state(str(path))
    assert not path.exists()
    assert (tmp_path / "state.json.broken").read_bytes() == half


def test_what_is_no_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="can not be read"):
        load_state(str(tmp_path))
