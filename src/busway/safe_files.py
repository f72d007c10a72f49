"""Safe opening of files that a configuration names: only regular files, and not through links of other users.

Knows names and kinds of files; knows nothing of their contents.

1. Only a regular file is opened. A pipe, a device or a directory is refused with an error, without waiting for data.
2. A symbolic link anywhere in the path is followed if it belongs to root or to the user who runs the program. A link
   of another user is refused, because that user could let it point to any file (CWE-59). The resolved path is opened
   by a call that does not follow a link at its end, so a link that replaces the file meanwhile is refused too.
3. A file is replaced only if its first bytes show that it is of the kind to be written. So no other file is lost where
   its name was given by mistake.
"""

import errno
import os
import stat
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from .errors import ConfigError

HEAD: Final = 256
"""Number of bytes at the beginning of a file that `IsOurs` gets, to recognise its kind."""
_MOST_LINKS: Final = 40
"""Symbolic links that are followed in one path, at most; Linux has the same limit."""
_ALWAYS: Final = getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
_NO_WAIT: Final = getattr(os, "O_NONBLOCK", 0)
_NO_LINK: Final = getattr(os, "O_NOFOLLOW", 0)
_ROOT: Final = 0

IsOurs = Callable[[bytes], bool]
"""A function that takes the first `HEAD` bytes of a file and returns whether the file may be replaced."""


def read_safely(path: str | os.PathLike[str], *, most: int) -> bytes:
    """Return the contents of a regular file.

    Args:
        path: path of the file.
        most: largest allowed size in bytes.

    Raises:
        ConfigError: the file cannot be read, is no regular file, has more than ``most`` bytes, or is reached through a
            link of another user. ``file`` holds the path.
    """
    handle = _opened(path, os.O_RDONLY)
    with os.fdopen(handle, "rb") as file:
        try:
            data = file.read(most + 1)
        except OSError as error:
            raise _refusal(path, "cannot be read", error) from error
    if len(data) > most:
        raise ConfigError(f"is larger than {size_text(most)}, the limit for such a file", file=os.fspath(path))
    return data


def open_to_read(path: str | os.PathLike[str]) -> int:
    """Open a regular file of any size for reading, and return its file descriptor.

    Raises:
        ConfigError: the file cannot be opened, is no regular file, or is reached through a link of another user.
    """
    return _opened(path, os.O_RDONLY)


def open_to_append(path: str | os.PathLike[str], *, mode: int = 0o600) -> int:
    """Open a regular file for appending, and return its file descriptor. A missing file is created.

    Args:
        path: path of the file.
        mode: access rights of a file that is created, before the umask.

    Raises:
        ConfigError: the file cannot be opened, is no regular file, or is reached through a link of another user.
    """
    return _opened(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, mode)


def open_to_replace(path: str | os.PathLike[str], *, is_ours: IsOurs, kind: str, mode: int = 0o666) -> int:
    """Empty a regular file and return its file descriptor, open for reading and writing. A missing file is created.

    Args:
        path: path of the file.
        is_ours: called with the first bytes of the old contents, unless the file is empty; returns whether they may be
            deleted.
        kind: what is going to be written, for the error: ``capture``.
        mode: access rights of a file that is created, before the umask.

    Raises:
        ConfigError: the file cannot be opened, is no regular file, is reached through a link of another user, or
            ``is_ours`` returned False. The contents are unchanged then.
    """
    handle = _opened(path, os.O_RDWR | os.O_CREAT, mode)
    try:
        head = os.read(handle, HEAD)
        if head and not is_ours(head):
            raise _no_such_kind(path, kind)
        os.lseek(handle, 0, os.SEEK_SET)
        os.ftruncate(handle, 0)
    except BaseException as error:
        os.close(handle)
        if isinstance(error, OSError):
            raise _refusal(path, "cannot be written", error) from error
        raise
    return handle


def check_replaceable(path: str | os.PathLike[str], *, is_ours: IsOurs, kind: str) -> str:
    """Check that a file is missing, empty or of the expected kind, so that another file may be renamed to its path.

    Nothing is changed. Returns the absolute path with all symbolic links resolved.

    Args:
        path: path of the file.
        is_ours: called with the first bytes of the file, unless it is missing or empty; returns whether it may be
            replaced.
        kind: what is going to be written, for the error: ``capture``.

    Raises:
        ConfigError: the file is there and cannot be read, is no regular file, or ``is_ours`` returned False for its
            first bytes; or the path leads through a link of another user.
    """
    found = past_links(path)
    if not os.path.lexists(found):
        return found
    handle = _opened(found, os.O_RDONLY)
    try:
        head = os.read(handle, HEAD)
    except OSError as error:
        raise _refusal(path, "cannot be read", error) from error
    finally:
        os.close(handle)
    if head and not is_ours(head):
        raise _no_such_kind(path, kind)
    return found


def write_whole(path: str | os.PathLike[str], text: str, *, like: os.stat_result | None = None) -> None:
    """Replace or create a file; after a crash or a power failure it has its old or its new contents, never a part.

    Args:
        path: path of the file. If it is a symbolic link, the link itself is replaced. A device, a pipe, a socket and a
            folder are never replaced.
        text: the new contents, written as UTF-8.
        like: status of the file whose owner, group and access rights the new file gets, as far as the user may set
            them; None for access by the owner alone (0600).

    Raises:
        OSError: the path names something that is not a file, or the file could not be written. If only the folder
            could not be synchronised to the disk, the file has its new contents already; otherwise it is as it was.
    """
    target = Path(path)
    if os.path.lexists(target) and not target.is_symlink() and not target.is_file():
        raise OSError(errno.EINVAL, "Not a regular file", str(target))
    fresh = target.with_name(f"{target.name}.{os.getpid()}.new")
    fresh.unlink(missing_ok=True)  # of a process of the same number that was killed
    handle = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _ALWAYS, 0o600)
    with ExitStack() as unless_replaced:
        unless_replaced.callback(fresh.unlink, missing_ok=True)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            if like is not None:
                _give_rights(handle, like)
            file.write(text)
            file.flush()
            os.fsync(handle)
        fresh.replace(target)
        unless_replaced.pop_all()
    if hasattr(os, "O_DIRECTORY"):
        folder = os.open(target.parent, os.O_RDONLY | os.O_DIRECTORY | _ALWAYS)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _give_rights(handle: int, like: os.stat_result) -> None:
    """Give an open file the owner, group and access rights in ``like``, as far as this user may set them.

    If the owner cannot be set, only the group is set. If the group cannot be set either, the rights of the group are
    reduced to those of all other users.
    """
    mode = stat.S_IMODE(like.st_mode)
    own = os.fstat(handle)
    try:
        if (own.st_uid, own.st_gid) != (like.st_uid, like.st_gid):
            os.fchown(handle, like.st_uid, like.st_gid)
    except PermissionError:
        try:
            os.fchown(handle, -1, like.st_gid)
        except PermissionError:
            mode &= ~stat.S_IRWXG | (mode & stat.S_IRWXO) << 3
    os.fchmod(handle, mode)


def past_links(path: str | os.PathLike[str]) -> str:
    """Return the absolute path of a file with all symbolic links resolved; the file itself can be missing.

    If a folder in the path is missing, the rest of the path is returned as it was given.

    Raises:
        ConfigError: a link in the path belongs to another user, there are more than 40 links (they may form a circle),
            or a step of the path cannot be examined.
    """
    given = os.fspath(path)
    try:
        return _past_links(given)
    except (OSError, ValueError) as error:
        raise _refusal(given, "cannot be opened", error) from error


def _past_links(given: str) -> str:
    whole = Path(os.path.abspath(given) if os.name == "nt" else os.path.join(os.getcwd(), given))
    found, left = Path(whole.anchor), list(whole.parts[1:])
    links = 0
    while left:
        part = left.pop(0)
        if part == os.pardir:
            found = found.parent
            continue
        here = found / part
        try:
            facts = os.lstat(here)
        except FileNotFoundError:
            return str(here.joinpath(*left))
        if not stat.S_ISLNK(facts.st_mode):
            found = here
            continue
        links += 1
        if links > _MOST_LINKS:
            raise ConfigError("leads through too many symbolic links", file=given)
        _refuse_foreign(here, facts, given)
        target = Path(os.readlink(here))
        left = [*(target.parts[1:] if target.is_absolute() else target.parts), *left]
        found = Path(target.anchor) if target.is_absolute() else found
    return str(found)


def _refuse_foreign(link: Path, facts: os.stat_result, given: str) -> None:
    user = getattr(os, "geteuid", None)
    if user is not None and facts.st_uid not in (_ROOT, user()):
        raise ConfigError(
            f"is reached by the symbolic link {link} of another user (number {facts.st_uid}); "
            "name the file itself, or let root or the user of this program make the link",
            file=given,
        )


def _opened(path: str | os.PathLike[str], flags: int, mode: int = 0o666) -> int:
    """Open a regular file and return its file descriptor.

    Args:
        path: path of the file; links are resolved by `past_links`.
        flags: flags of `os.open`.
        mode: access rights of a file that is created, before the umask.

    Raises:
        ConfigError: the file cannot be opened, is no regular file, or is reached through a link of another user.
    """
    name = past_links(path)
    try:
        handle = os.open(name, flags | _ALWAYS | _NO_WAIT | _NO_LINK, mode)
    except (OSError, ValueError) as error:
        if os.path.exists(name) and not os.path.isfile(name):
            raise _no_file(path, os.stat(name).st_mode) from error
        raise _refusal(path, "cannot be opened", error) from error
    facts = os.fstat(handle)
    if not stat.S_ISREG(facts.st_mode):
        os.close(handle)
        raise _no_file(path, facts.st_mode)
    if _NO_WAIT:
        os.set_blocking(handle, True)
    return handle


def _no_file(path: str | os.PathLike[str], mode: int) -> ConfigError:
    kinds = {
        stat.S_IFDIR: "a directory",
        stat.S_IFIFO: "a pipe",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
        stat.S_IFSOCK: "a socket",
    }
    found = kinds.get(stat.S_IFMT(mode), "something else")
    return ConfigError(f"cannot be opened: it is {found}, and a regular file is needed", file=os.fspath(path))


def _no_such_kind(path: str | os.PathLike[str], kind: str) -> ConfigError:
    return ConfigError(
        f"is there already and is no {kind}, so it is not overwritten; choose another name or remove it",
        file=os.fspath(path),
    )


def _refusal(path: str | os.PathLike[str], what: str, error: OSError | ValueError) -> ConfigError:
    reason = getattr(error, "strerror", None) or str(error)
    return ConfigError(f"{what}: {reason[:1].lower()}{reason[1:]}", file=os.fspath(path))


def size_text(size: int) -> str:
    """Return a number of bytes as text, in the largest binary unit in which it is a whole number: ``4 MiB``."""
    for unit, name in ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")):
        if size >= unit and size % unit == 0:
            return f"{size // unit} {name}"
    return f"{size} bytes"
