"""Opens files that a configuration names safely: only regular files of limited size, not through links of other users.

Knows names and kinds of files; knows nothing of what stands in them.

1. Only a regular file is opened. A pipe, a device or a directory is refused with a sentence, and nothing waits for one.
2. A symbolic link is followed if it belongs to the user who runs the program or to root, wherever in the path it
   stands. One of another user is refused: he could let it point anywhere (CWE-59). The last step is taken by a call
   that follows no link, so one that is put there meanwhile is refused too.
3. What is replaced must be recognised by its first bytes. Another file is never overwritten because
   its name was written down by mistake.
"""

import os
import stat
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from .errors import ConfigError

HEAD: Final = 256
"""Bytes from the beginning of a file that identify it."""
_MOST_LINKS: Final = 40
"""As many links does Linux follow in one path."""
_ALWAYS: Final = getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
_NO_WAIT: Final = getattr(os, "O_NONBLOCK", 0)
_NO_LINK: Final = getattr(os, "O_NOFOLLOW", 0)
_ROOT: Final = 0

IsOurs = Callable[[bytes], bool]
"""Takes the first `HEAD` bytes of a file, and says whether it may be replaced."""


def read_safely(path: str | os.PathLike[str], *, most: int) -> bytes:
    """Return the contents of a regular file, which must not be a device, a pipe or another user's link.

    Args:
        path: the file.
        most: bytes that it may have.

    Raises:
        ConfigError: it cannot be read, is no regular file, is larger, or is reached by a link of another user; names
            the file.
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
    """Open a regular file of any size for reading, and return its descriptor.

    Raises:
        ConfigError: it cannot be opened, is no regular file, or is reached by a link of another user; names the file.
    """
    return _opened(path, os.O_RDONLY)


def open_to_append(path: str | os.PathLike[str], *, mode: int = 0o600) -> int:
    """Open a regular file for appending, and return its descriptor; created with ``mode`` if it is missing.

    Raises:
        ConfigError: it cannot be opened, is no regular file, or is reached by a link of another user; names the file.
    """
    return _opened(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, mode)


def open_to_replace(path: str | os.PathLike[str], *, is_ours: IsOurs, kind: str, mode: int = 0o666) -> int:
    """Open a regular file with its contents removed, and return its descriptor; created if it is missing.

    Args:
        path: the file.
        is_ours: says by the first bytes of the old content whether it may go. Not asked about an empty file.
        kind: what is written, for the sentence: ``capture``.
        mode: rights of a file that is made, before the umask.

    Raises:
        ConfigError: it cannot be opened, is no regular file, is reached by a link of another user, or holds something
            else, and is as it was then; names the file.
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
    """Check that a file may be replaced by renaming another one to it, or is missing. Returns its path without links.

    Raises:
        ConfigError: as of `open_to_replace`.
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
    """Replace a file, or make it: after a crash or a power failure it is as before or as after, never between.

    Args:
        path: the file; a link there is replaced itself.
        text: the new contents.
        like: the file gets the owner, group and rights of this one, as far as they can be given; None for the owner's
            rights alone (0600).

    Raises:
        OSError: the file is as it was.
    """
    target = Path(path)
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
    """Copy the access rights of an open file to another one, except rights that a different group would gain."""
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
    """An absolute path to the same file with all links resolved.

    The file itself need not be there. Raises `ConfigError` where a link belongs to another user, or leads in a circle.
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
    """Open a regular file and return its descriptor; raises for any other kind of file."""
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
    """A number of bytes in the largest binary unit that holds it whole: ``4 MiB``."""
    for unit, name in ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")):
        if size >= unit and size % unit == 0:
            return f"{size // unit} {name}"
    return f"{size} bytes"
