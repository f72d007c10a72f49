"""Files named in a configuration: what is opened, and what is refused with a sentence and stays as it was."""

import os
import stat
from pathlib import Path

import pytest

from busway.errors import ConfigError
from busway.safe_files import (
    check_replaceable,
    open_to_append,
    open_to_replace,
    past_links,
    read_safely,
    write_whole,
)

needs_unix = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes and owners of links are of Unix")
_STRANGER = 12_345


def a_strangers_link(link: Path, target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A link that belongs neither to root nor to the user of this process."""
    link.symlink_to(target)
    if os.geteuid() == 0:
        os.lchown(link, _STRANGER, _STRANGER)
    else:
        monkeypatch.setattr("os.geteuid", lambda: _STRANGER)


def ours(head: bytes) -> bool:
    return head.startswith(b"ours")


def test_a_file_is_read_up_to_its_limit(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_bytes(b"x" * 1024)
    assert read_safely(file, most=1024) == b"x" * 1024
    with pytest.raises(ConfigError, match=r"is larger than 1023 bytes"):
        read_safely(file, most=1023)


def test_the_limit_is_said_in_units(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_bytes(b"x" * 3000)
    with pytest.raises(ConfigError, match="is larger than 2 KiB, the limit for such a file"):
        read_safely(file, most=2048)


@needs_unix
def test_a_pipe_is_refused_at_once_whether_it_is_read_or_written(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for attempt in (
        lambda: read_safely(pipe, most=100),
        lambda: open_to_append(pipe),
        lambda: open_to_replace(pipe, is_ours=ours, kind="capture"),
        lambda: check_replaceable(pipe, is_ours=ours, kind="capture"),
    ):
        with pytest.raises(ConfigError, match="it is a pipe, and a regular file is needed"):
            attempt()


@needs_unix
def test_a_device_and_a_directory_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="it is a device"):
        read_safely("/dev/zero", most=100)
    with pytest.raises(ConfigError, match="it is a directory"):
        read_safely(tmp_path, most=100)
    with pytest.raises(ConfigError, match="it is a directory"):
        open_to_append(tmp_path)


def test_what_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file") as caught:
        read_safely(tmp_path / "nothing", most=100)
    assert caught.value.file == str(tmp_path / "nothing")


@needs_unix
def test_an_own_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a").write_bytes(b"ours")
    (tmp_path / "folder").symlink_to("real")
    (tmp_path / "link").symlink_to("folder/../real/a")
    assert read_safely(tmp_path / "link", most=100) == b"ours"
    assert past_links(tmp_path / "folder" / "new") == str(tmp_path.resolve() / "real" / "new")


@needs_unix
@pytest.mark.parametrize("inside", [False, True], ids=["the file", "a folder above"])
def test_a_link_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, inside: bool) -> None:
    (tmp_path / "real").mkdir()
    target = tmp_path / "real" / "a"
    target.write_bytes(b"ours, and precious")
    link = tmp_path / "link"
    a_strangers_link(link, tmp_path / "real" if inside else target, monkeypatch)
    name = link / "a" if inside else link
    for attempt in (
        lambda: read_safely(name, most=100),
        lambda: open_to_append(name),
        lambda: open_to_replace(name, is_ours=ours, kind="capture"),
        lambda: check_replaceable(name, is_ours=ours, kind="capture"),
    ):
        with pytest.raises(ConfigError, match=r"symbolic link .* of another user"):
            attempt()
    assert target.read_bytes() == b"ours, and precious"


@needs_unix
def test_links_in_a_circle_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(ConfigError, match="too many symbolic links"):
        read_safely(tmp_path / "a", most=100)


def test_an_appended_file_keeps_what_stands_in_it_and_is_made_for_its_owner(tmp_path: Path) -> None:
    file = tmp_path / "log"
    for line in (b"one\n", b"two\n"):
        handle = open_to_append(file)
        os.write(handle, line)
        os.close(handle)
    assert file.read_bytes() == b"one\ntwo\n"
    if hasattr(os, "geteuid"):
        assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_only_what_is_recognised_is_replaced(tmp_path: Path) -> None:
    file, other = tmp_path / "a", tmp_path / "b"
    for before in (None, b"", b"ours, and old"):
        if before is not None:
            file.write_bytes(before)
        handle = open_to_replace(file, is_ours=ours, kind="capture")
        os.write(handle, b"ours")
        os.close(handle)
        assert file.read_bytes() == b"ours"
    assert check_replaceable(file, is_ours=ours, kind="capture") == str(file.resolve())
    other.write_bytes(b"theirs")
    with pytest.raises(ConfigError, match="is there already and is no capture, so it is not overwritten"):
        open_to_replace(other, is_ours=ours, kind="capture")
    with pytest.raises(ConfigError, match="is there already and is no capture"):
        check_replaceable(other, is_ours=ours, kind="capture")
    assert other.read_bytes() == b"theirs"


def test_a_file_is_replaced_whole_or_not_at_all_and_its_owner_alone_can_read_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a"
    write_whole(file, "first")
    assert (file.read_text(), file.stat().st_mode & 0o777) == ("first", 0o600)
    with pytest.raises(UnicodeEncodeError):
        write_whole(file, "second \ud800")

    def fail(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space"):
        write_whole(file, "third")
    assert file.read_text() == "first"
    assert list(tmp_path.iterdir()) == [file]


@needs_unix
def test_only_a_file_is_replaced_whole(tmp_path: Path) -> None:
    pipe, folder = tmp_path / "pipe", tmp_path / "folder"
    os.mkfifo(pipe)
    folder.mkdir()
    for target in (pipe, folder):
        before = target.stat()
        with pytest.raises(OSError, match="Not a regular file"):
            write_whole(target, "text")
        assert target.stat().st_ino == before.st_ino
    assert sorted(tmp_path.iterdir()) == [folder, pipe]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives files away")
def test_a_file_that_is_replaced_keeps_owner_and_group(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_text("old")
    file.chmod(0o640)
    os.chown(file, 1234, 2345)
    write_whole(file, "new", like=file.stat())
    found = file.stat()
    assert (file.read_text(), found.st_uid, found.st_gid, found.st_mode & 0o777) == ("new", 1234, 2345, 0o640)


@needs_unix
@pytest.mark.parametrize(("mode", "left"), [(0o640, 0o600), (0o664, 0o644), (0o600, 0o600)])
def test_a_group_that_cannot_be_given_its_file_leaves_its_rights_to_no_other_group(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: int, left: int
) -> None:
    file = tmp_path / "a"
    file.write_text("old")
    file.chmod(mode)
    facts = file.stat()
    other = os.stat_result((facts.st_mode, 0, 0, 1, facts.st_uid, facts.st_gid + 1, 0, 0, 0, 0))

    def refused(handle: int, user: int, group: int) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "fchown", refused)
    write_whole(file, "new", like=other)
    assert file.stat().st_mode & 0o777 == left
