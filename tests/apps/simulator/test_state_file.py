"""The file of kept values: whole or as it was, and put aside where it means nothing."""

import os
import stat
from pathlib import Path

import pytest

from busway.apps.simulator.state_file import KeptPoint, KeptState, load_state, save_state
from busway.errors import ConfigError

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


def test_what_cannot_be_written_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    with pytest.raises(ConfigError, match="cannot be read, and stand in"):
        load_state(str(path))
    assert not path.exists()
    assert (tmp_path / "state.json.broken").read_bytes() == half


def test_what_is_no_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="it is a directory"):
        load_state(str(tmp_path))


def test_a_state_is_for_its_owner_alone_whatever_the_umask_says(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    before = os.umask(0o000)
    try:
        save_state(str(path), STATE)
        save_state(str(path), STATE)
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def strangers_link(link: Path, target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A link that belongs neither to root nor to the user of this process."""
    link.symlink_to(target)
    if os.geteuid() == 0:
        os.lchown(link, 12_345, 12_345)
    else:
        monkeypatch.setattr("os.geteuid", lambda: 12_345)


def test_a_state_is_not_written_through_a_link_of_another_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target, link = tmp_path / "precious", tmp_path / "state.json"
    strangers_link(link, target, monkeypatch)
    with pytest.raises(ConfigError, match="of another user"):
        save_state(str(link), STATE)
    assert not target.exists()
    save_state(str(target), STATE)
    with pytest.raises(ConfigError, match="of another user"):
        load_state(str(link))


def test_a_link_of_ones_own_is_followed_and_stays(tmp_path: Path) -> None:
    target, link = tmp_path / "kept.json", tmp_path / "state.json"
    link.symlink_to(target)
    save_state(str(link), STATE)
    assert link.is_symlink()
    assert load_state(str(target)) == load_state(str(link)) == STATE


def test_a_link_that_waits_where_the_new_file_is_made_is_not_followed(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("precious")
    (tmp_path / f"state.json.{os.getpid()}.new").symlink_to(precious)
    save_state(str(tmp_path / "state.json"), STATE)
    assert precious.read_text() == "precious"
    assert load_state(str(tmp_path / "state.json")) == STATE


def test_what_means_nothing_stays_where_a_file_of_another_kind_has_the_name_beside(tmp_path: Path) -> None:
    path, beside = tmp_path / "state.json", tmp_path / "state.json.broken"
    save_state(str(path), STATE)
    path.write_bytes(path.read_bytes()[:100])
    beside.write_text("precious")
    with pytest.raises(ConfigError, match=r"stand where they stood, because .*is no state of a simulation"):
        load_state(str(path))
    assert beside.read_text() == "precious"
    assert len(path.read_bytes()) == 100
