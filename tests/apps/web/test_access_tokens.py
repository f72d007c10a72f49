"""The file of tokens: made once, for its owner alone; read again when it changes; refused where others can read it."""

import errno
import logging
import os
from pathlib import Path

import pytest

from busway.apps.web.access_tokens import KeptTokens
from busway.apps.web.request_guard import AccessToken, Role
from busway.errors import ConfigError

LONG = "a-token-that-is-long-enough"


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    path.chmod(0o600)
    return path


def test_a_file_with_a_random_token_for_each_role_is_made_for_its_owner_alone(tmp_path: Path) -> None:
    os.umask(old := os.umask(0))
    os.umask(0)
    try:
        one, other = KeptTokens(tmp_path / "one").current(), KeptTokens(tmp_path / "other").current()
    finally:
        os.umask(old)
    assert (tmp_path / "one").stat().st_mode & 0o777 == 0o600
    assert [each.caller.role for each in one] == [Role.VIEW, Role.OPERATE, Role.CONFIGURE]
    assert len({each.digest for each in (*one, *other)}) == 6
    tokens = [line.split()[1] for line in (tmp_path / "one").read_text().splitlines() if line[0] != "#"]
    assert all(len(token) >= 32 for token in tokens)
    assert KeptTokens(tmp_path / "one").current() == one


def test_a_new_file_of_tokens_is_durable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda file: sizes.append(os.fstat(file).st_size))
    KeptTokens(tmp_path / "tokens")
    assert sizes[0] == (tmp_path / "tokens").stat().st_size


def test_a_file_of_tokens_for_which_the_disk_has_no_room_is_told_and_not_left_empty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_room(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", no_room)
        with pytest.raises(ConfigError, match="cannot be written: No space left on device"):
            KeptTokens(tmp_path / "tokens")
    assert len(KeptTokens(tmp_path / "tokens").current()) == 3


def test_further_tokens_have_names(tmp_path: Path) -> None:
    kept = KeptTokens(written(tmp_path / "tokens", f"# ours\n\noperate {LONG} anna of shift 2\nview {LONG}2\n"))
    assert [(each.caller.name, each.caller.role) for each in kept.current()] == [
        ("anna of shift 2", Role.OPERATE),
        ("view", Role.VIEW),
    ]
    assert kept.current()[0] == AccessToken.of(LONG, "anna of shift 2", Role.OPERATE)


def test_a_token_that_is_removed_from_the_file_is_no_longer_taken(tmp_path: Path) -> None:
    kept = KeptTokens(written(tmp_path / "tokens", f"operate {LONG}\nview {LONG}2\n"))
    written(tmp_path / "tokens", f"view {LONG}2\n")
    assert [each.caller.role for each in kept.current()] == [Role.VIEW]


def test_a_file_that_becomes_wrong_is_logged_and_adds_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    kept = KeptTokens(written(tmp_path / "tokens", f"operate {LONG}\n"))
    before = kept.current()
    with caplog.at_level(logging.ERROR, "busway.apps.web"):
        written(tmp_path / "tokens", f"operate short\noperate {LONG}\noperate {LONG}2\n")
        assert kept.current() == kept.current() == before
    assert len(caplog.records) == 1
    assert "line 1" in caplog.text
    assert "short" not in caplog.text


@pytest.mark.parametrize("text", ["", "# none\n", f"view {LONG}\n\nview short\n", f"# operate {LONG}\nview\n", None])
def test_a_token_that_stands_no_longer_in_a_file_that_became_wrong_is_no_longer_taken(
    tmp_path: Path, text: str | None
) -> None:
    path = written(tmp_path / "tokens", f"operate {LONG} anna\nview {LONG}2\n")
    kept = KeptTokens(path)
    if text is None:
        path.unlink()
    else:
        written(path, text)
    assert kept.current() == kept.current() == ()
    written(path, f"operate {LONG} anna\n")
    assert [each.caller.name for each in kept.current()] == ["anna"]


def test_a_file_of_the_same_size_and_time_is_read_again(tmp_path: Path) -> None:
    kept = KeptTokens(path := written(tmp_path / "tokens", f"operate {LONG}1\n"))
    before = path.stat().st_mtime_ns
    written(tmp_path / "new", f"operate {LONG}2\n").rename(path)
    os.utime(path, ns=(before, before))
    assert [each.digest for each in kept.current()] == [AccessToken.of(f"{LONG}2", "", Role.OPERATE).digest]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "has no token"),
        ("# nothing\n", "has no token"),
        (f"admin {LONG}\n", "line 1: a line begins with view, operate, configure"),
        (f"view {LONG}\noperate\n", "line 2: a token has at least 16"),
        ("operate too-short\n", "line 1: a token has at least 16"),
        ("operate spaces-né-à-la-mer-du-nord\n", "line 1"),
        (f"view {LONG}\n" * 101, "more than 100"),
    ],
)
def test_a_file_that_cannot_be_is_refused_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        KeptTokens(written(tmp_path / "tokens", text))
    assert LONG not in str(caught.value)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660])
def test_a_file_that_others_can_read_is_refused(tmp_path: Path, mode: int) -> None:
    path = written(tmp_path / "tokens", f"operate {LONG}\n")
    path.chmod(mode)
    with pytest.raises(ConfigError, match="chmod 600"):
        KeptTokens(path)


def test_a_token_is_in_no_text_of_its_object() -> None:
    token = AccessToken.of(LONG, "anna", Role.OPERATE)
    assert LONG not in repr(token)
    assert token.digest.hex() not in repr(token)
    assert repr(token.digest) not in repr(token)
