"""Addresses of control sockets (which ``busway status`` asks), and the directories that contain them.

Knows paths and the environment; creates the directory, and opens no file or socket.

1. The directory is ``busway`` in ``$XDG_RUNTIME_DIR`` if that exists, else ``busway-<user id>`` in the directory of
   temporary files. It must belong to the user and be closed to others; otherwise it is refused, since another user may
   have created it.
2. The directory holds ``<name>.sock`` for a Unix domain socket, ``<name>.json`` with URL and token for loopback HTTP.
   The name of a socket is the process id, with a number appended for further sockets of one process; the name of a
   token file is the process id and the port.
"""

import os
import socket
import stat
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Final

from ...errors import ConfigError
from ...options.text import host_and_port

HAS_UNIX_SOCKETS = hasattr(socket, "AF_UNIX")
KEY = "control"
OFF: Final = "off"
"""The word that stands in place of an address for "no control socket"."""
SOCKET_SUFFIX = ".sock"
TOKEN_SUFFIX = ".json"


@dataclass(frozen=True, slots=True)
class UnixAddress:
    """The address of a control service on a Unix domain socket: the path of the socket."""

    path: Path

    def __str__(self) -> str:
        return str(self.path)


@dataclass(frozen=True, slots=True)
class LoopbackAddress:
    """The address of a control service over HTTP: a numeric loopback address, and a port (0 binds a free one)."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"http://[{self.host}]:{self.port}" if ":" in self.host else f"http://{self.host}:{self.port}"


ControlAddress = UnixAddress | LoopbackAddress


def parse_control_address(text: str) -> ControlAddress:
    """Parse the address of a control service: a socket path, ``127.0.0.1:0``, or ``http://127.0.0.1:4711``.

    A text that is no URL, and has a slash or no ``:PORT`` at its end, is the path of a Unix socket. The host
    ``localhost`` becomes ``127.0.0.1``.

    Raises:
        ConfigError: the text is empty, is a URL of another scheme or without a valid port, or its host is neither
            ``localhost`` nor a numeric loopback address.
    """
    scheme, separator, _ = text.partition("://")
    if separator and scheme != "http" and os.sep not in scheme:
        raise ConfigError(
            f"{text} is no control service, which has a socket path or http://127.0.0.1:PORT; a device at a Modbus URL "
            "is asked by busway read, identify or counters",
            key=KEY,
        )
    host_port = text.removeprefix("http://").removesuffix("/")
    _, colon, port_text = text.rpartition(":")
    if not text.startswith("http://") and (os.sep in text or not colon or not port_text.isdigit()):
        if not text:
            raise ConfigError("a path or an address such as 127.0.0.1:0 is needed", key=KEY)
        return UnixAddress(Path(text))
    host, port = host_and_port(host_port, KEY)
    host = "127.0.0.1" if host == "localhost" else host
    if not is_loopback(host):
        raise ConfigError(f"only an address of this host's loopback can be, not {host!r}", key=KEY)
    return LoopbackAddress(host, port)


def is_loopback(host: str) -> bool:
    """Whether a host is a numeric loopback address, such as ``127.0.0.1`` or ``::1``; False for host names."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def control_directory(environment: Mapping[str, str] | None = None) -> Path:
    """Return the directory for control sockets of this user; it is created with mode 0700 if it is missing.

    Args:
        environment: environment variables to use instead of those of the process.

    Raises:
        ConfigError: the directory cannot be created, its path is no directory, it belongs to another user, or it is
            open to others.
    """
    path = _candidates(environment)[0]
    try:
        path.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"the directory {path} cannot be made: {error.strerror or error}", key=KEY) from error
    problem = _problem(path)
    if problem:
        raise ConfigError(problem, key=KEY)
    return path


def control_directories(environment: Mapping[str, str] | None = None) -> list[Path]:
    """Return all existing directories that may hold control sockets of this user, the preferred one first.

    There may be two, since a service may lack the ``XDG_RUNTIME_DIR`` that a shell has. Directories that do not belong
    to the user alone are left out.

    Args:
        environment: environment variables to use instead of those of the process.
    """
    return [path for path in _candidates(environment) if path.exists() and not _problem(path)]


def _candidates(environment: Mapping[str, str] | None) -> list[Path]:
    """Return the directories that control sockets of this user may be in, existing or not, the preferred one first."""
    runtime = (os.environ if environment is None else environment).get("XDG_RUNTIME_DIR", "")
    own = f"busway-{os.getuid()}" if hasattr(os, "getuid") else "busway"
    temporary = Path(tempfile.gettempdir()) / own
    if os.path.isabs(runtime) and os.path.isdir(runtime):
        return [Path(runtime) / "busway", temporary]
    return [temporary]


def _problem(path: Path) -> str:
    """Return as a sentence why an existing path is no directory that is private to this user; empty if it is one.

    A symbolic link is none. Where the system has no user numbers, every directory counts as private.
    """
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode):
        return f"{path} is no directory"
    if hasattr(os, "getuid") and (found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o077):
        return f"the directory {path} must be yours alone, of mode 0700"
    return ""
