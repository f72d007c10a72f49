"""Creates and removes the control socket, at which a program answers requests for its status.

Knows sockets, files and their modes; knows no request.

1. At no moment can another user connect: a Unix socket gets its mode before it listens, a token file gets its mode
   before the token is written.
2. A socket or token file that a dead program has left behind is replaced. If a program answers at a socket, or the file
   is something else, it is left alone.
3. At the end a file is removed only if it is still the one that was created.
"""

import contextlib
import json
import os
import secrets
import socket
import stat
import struct
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

from ...errors import ConfigError, LinkDown
from ...observe.http import bind_tcp, bound_name
from ...transport.tcp import network_kind
from .addresses import HAS_UNIX_SOCKETS, KEY, SOCKET_SUFFIX, TOKEN_SUFFIX, ControlAddress, LoopbackAddress, UnixAddress

_LONGEST_PATH = 103
"""The longest path of a Unix socket, in bytes, that every system accepts; Linux accepts 107."""
_CONNECT_SECONDS = 1.0


@dataclass
class Bound:
    """The bound socket of a control service, and the file that belongs to it.

    Attributes:
        socket: the bound socket; it does not listen yet.
        address: the address that it is bound to, with the real port.
        token: token that each request must carry; empty for a Unix socket, which the mode of its file protects.
    """

    socket: socket.socket
    address: ControlAddress
    token: str = ""
    _made: Path | None = None
    _identity: tuple[int, int] = field(default=(0, 0))

    def remember(self, made: Path) -> None:
        """Store which file was created for this socket (the Unix socket or the token file), for `remove`."""
        found = made.lstat()
        self._made, self._identity = made, (found.st_dev, found.st_ino)

    def remove(self) -> None:
        """Delete the file stored by `remember`, unless another program has replaced it.

        The socket itself stays open.
        """
        made, self._made = self._made, None
        if made is None:
            return
        with contextlib.suppress(OSError):
            found = made.lstat()
            if (found.st_dev, found.st_ino) == self._identity:
                made.unlink()


def bind_default(directory: Path) -> Bound:
    """Create and bind a Unix control socket in a directory, named after this process; it does not listen yet.

    Further sockets of the process get the first free number appended. Sockets that dead programs have left in the
    directory are removed first. On systems without Unix sockets, a loopback socket with a free port is bound, and its
    token file is in the directory.

    Raises:
        ConfigError: the path of the socket is too long.
        LinkDown: the socket cannot be bound, or its token cannot be written.
    """
    sweep(directory)
    for number in count(1):
        name = str(os.getpid()) if number == 1 else f"{os.getpid()}-{number}"
        if not HAS_UNIX_SOCKETS:
            return bind_loopback(LoopbackAddress("127.0.0.1", 0), directory)
        path = directory / f"{name}{SOCKET_SUFFIX}"
        if not path.exists():
            return bind_unix(UnixAddress(path))
    raise AssertionError("count() has no end")


def bind_unix(address: UnixAddress) -> Bound:
    """Create and bind a Unix domain socket of mode 0600 for a control service; it does not listen yet.

    A socket at the path at which no program answers is replaced.

    Raises:
        ConfigError: another file is at the path, the path is too long, or this system has no Unix domain sockets.
        LinkDown: the socket cannot be bound, or a running program answers at the path.
    """
    path = address.path.absolute()
    if not HAS_UNIX_SOCKETS:
        raise ConfigError("this system has no Unix domain sockets; 127.0.0.1:0 is possible", key=KEY)
    if len(os.fsencode(path)) > _LONGEST_PATH:
        raise ConfigError(f"the path {path} is longer than {_LONGEST_PATH} bytes", key=KEY)
    _make_room(path)
    bound = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        bound.bind(str(path))
        made = Bound(bound, UnixAddress(path))
        made.remember(path)
        path.chmod(0o600)
    except OSError as error:
        bound.close()
        raise LinkDown(f"cannot listen on {path}: {error.strerror or error}", kind=network_kind(error)) from error
    return made


def bind_loopback(address: LoopbackAddress, directory: Path) -> Bound:
    """Create and bind a loopback socket for a control service; it does not listen yet.

    A new token is written with the URL into a file of mode 0600 in ``directory``.

    Raises:
        LinkDown: the address cannot be bound, or the token cannot be written.
    """
    bound = bind_tcp(address.host, address.port)
    real = LoopbackAddress(address.host, int(bound_name(bound).rpartition(":")[2]))
    made = Bound(bound, real, secrets.token_urlsafe(32))
    path = directory / f"{os.getpid()}-{real.port}{TOKEN_SUFFIX}"
    try:
        path.unlink(missing_ok=True)  # of a process that had our number before
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with open(descriptor, "w", encoding="utf-8") as file:
            json.dump({"url": str(real), "token": made.token}, file)
        made.remember(path)
    except OSError as error:
        bound.close()
        raise LinkDown(
            f"the token cannot be written to {path}: {error.strerror or error}", kind=network_kind(error)
        ) from error
    return made


def is_alive(path: Path) -> bool:
    """Whether a program listens at a Unix control socket.

    False only if the connection is refused or the file is missing. After any other failure the result is True, also if
    the connection is not accepted within a second.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(_CONNECT_SECONDS)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:  # too busy to answer, or not for us: not dead
            return True
        return True


def sweep(directory: Path) -> None:
    """Remove from a directory the Unix sockets at which no program listens: dead programs have left them."""
    for path in directory.glob(f"*{SOCKET_SUFFIX}"):
        with contextlib.suppress(OSError):
            if stat.S_ISSOCK(path.lstat().st_mode) and not is_alive(path):
                path.unlink()


def same_user(accepted: socket.socket) -> bool:
    """Whether the peer of an accepted Unix socket is of this process's user or root; True if the system cannot tell."""
    option = getattr(socket, "SO_PEERCRED", None)
    if option is None:
        return True
    size = struct.calcsize("3i")
    _, user, _ = struct.unpack("3i", accepted.getsockopt(socket.SOL_SOCKET, option, size))
    return user in (os.getuid(), 0)


def _make_room(path: Path) -> None:
    try:
        mode = path.lstat().st_mode
    except OSError:
        return
    if not stat.S_ISSOCK(mode):
        raise ConfigError(f"{path} is there and is no socket", key=KEY)
    if is_alive(path):
        raise LinkDown(f"cannot listen on {path}: a running program answers there", kind="taken")
    with contextlib.suppress(FileNotFoundError):
        path.unlink()
