"""Client of the control service: finds running servers and gateways, and asks them for their status.

Knows the client's side of HTTP over a Unix domain socket and over loopback; knows nothing of what a status contains.

1. All calls block; each of connecting, sending and receiving has its own time limit. At most `ANSWER_LIMIT` bytes of a
   response are read.
"""

import http.client
import json
import socket
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final

from ...errors import BadReply, ConfigError, LinkDown, ModbusError, NoReply
from ...transport.tcp import network_kind
from .addresses import (
    HAS_UNIX_SOCKETS,
    KEY,
    SOCKET_SUFFIX,
    TOKEN_SUFFIX,
    ControlAddress,
    LoopbackAddress,
    UnixAddress,
    parse_control_address,
)
from .control_socket import is_alive

ANSWER_LIMIT: Final = 64 * 1024 * 1024
_CONNECT_SECONDS: Final = 1.0
_ASK_SECONDS: Final = 5.0
_RELOAD_SECONDS: Final = 35.0
"""More than the service itself waits for a reload, so that its answer comes also if it gives up."""


@dataclass(frozen=True, slots=True)
class Running:
    """Address and token of the control service of one server or gateway; the program need not run any more.

    ``str()`` gives the address.

    Attributes:
        address: address of the control service.
        token: token that each request must carry; empty for a Unix domain socket.
    """

    address: ControlAddress
    token: str = ""

    def __str__(self) -> str:
        return str(self.address)


def find_running(*directories: Path) -> list[Running]:
    """Return the running programs whose control sockets or token files are in these directories.

    The order is that of the directories; within one, programs with a Unix socket come first, then those on loopback,
    each sorted by the name of the file. A connection to each is tried for at most a second. A program on loopback is
    left out if the connection fails; a Unix socket only if no program listens there, so a busy one is in the list.
    """
    found: list[Running] = []
    for directory in directories:
        if HAS_UNIX_SOCKETS:
            paths = sorted(directory.glob(f"*{SOCKET_SUFFIX}"))
            found += [Running(UnixAddress(path)) for path in paths if is_alive(path)]
        found += [one for one in _with_tokens(directory) if _answers(one)]
    return found


def find_one(text: str, *directories: Path) -> Running:
    """Return the program that a text names; whether it runs is not checked.

    Args:
        text: path of the control socket, URL, or name of a socket in one of the directories (a process id). A name
            that no directory has is taken as a path.
        directories: where sockets and token files are searched.

    Raises:
        ConfigError: the text is no address of a control service on this host, or the directories have no token for the
            URL.
    """
    address = parse_control_address(text)
    if isinstance(address, LoopbackAddress):
        known = [running for directory in directories for running in _with_tokens(directory)]
        for running in known:
            if running.address == address:
                return running
        raise ConfigError(f"no token for {address} is found; only the user who runs it has it", key=KEY)
    if address.path.name == text and not address.path.exists():
        for directory in directories:
            named = directory / f"{text}{SOCKET_SUFFIX}"
            if named.exists():
                return Running(UnixAddress(named))
    return Running(address)


def ask(running: Running, resource: str = "/status", *, method: str = "GET", timeout: float | None = None) -> Any:
    """Ask a running program for a resource of its control service, and return the decoded JSON.

    A successful response that is no JSON, such as the metrics, is returned as str. Blocks until the response has come.

    Args:
        running: the program.
        resource: ``/status``, ``/connections``, ``/metrics`` (GET), ``/reset-counters`` or ``/reload`` (POST).
        method: ``GET`` or ``POST``.
        timeout: seconds for each step: to connect, to send, to receive; None for 5 s, and for 35 s to reload, for which
            a program may take 30 s.

    Raises:
        LinkDown: no program answers at the address.
        NoReply: the response did not come in time, the program's event loop is stuck, or the program is about to end.
        ConfigError: the token is wrong, there is no such resource or method, or the request failed; the message says
            why.
        BadReply: the response is not valid HTTP or JSON, or an error that is not in JSON.
    """
    if timeout is None:
        timeout = _RELOAD_SECONDS if resource == "/reload" else _ASK_SECONDS
    connection = _Connection(running.address, timeout)
    try:
        headers = {"Authorization": f"Bearer {running.token}"} if running.token else {}
        connection.request(method, resource, headers=headers)
        response = connection.getresponse()
        body = response.read(ANSWER_LIMIT)
        kind = response.getheader("Content-Type", "")
    except TimeoutError as error:
        raise NoReply(f"no answer within {timeout:g} s", endpoint=str(running)) from error
    except http.client.HTTPException as error:
        raise BadReply(f"no answer in HTTP ({type(error).__name__})", kind="other", endpoint=str(running)) from error
    except OSError as error:
        raise LinkDown(
            f"no program answers: {error.strerror or error}", kind=network_kind(error), endpoint=str(running)
        ) from error
    finally:
        connection.close()
    if not kind.startswith("application/json"):
        if response.status == HTTPStatus.OK:
            return body.decode("utf-8", errors="replace")
        raise BadReply(f"status {response.status}", kind="other", endpoint=str(running))
    try:
        content = json.loads(body)
    except ValueError as error:
        raise BadReply("the answer is no JSON", kind="other", endpoint=str(running)) from error
    if response.status != HTTPStatus.OK:
        raise _error(response.status, content, running)
    return content


def _error(status: int, content: Any, running: Running) -> ModbusError:
    sentence = content.get("error", "") if isinstance(content, dict) else ""
    if status in (HTTPStatus.GATEWAY_TIMEOUT, HTTPStatus.SERVICE_UNAVAILABLE):
        return NoReply(str(sentence), endpoint=str(running))
    return ConfigError(str(sentence), key=str(running))


class _Connection(http.client.HTTPConnection):
    """HTTP connection to a control service, over a Unix domain socket or loopback."""

    def __init__(self, address: ControlAddress, timeout: float) -> None:
        if isinstance(address, LoopbackAddress):
            super().__init__(address.host, address.port, timeout=timeout)
        else:
            super().__init__("localhost", timeout=timeout)
        self._address = address

    def connect(self) -> None:
        """Connect to the control service. Raises `OSError` if that fails."""
        if isinstance(self._address, LoopbackAddress):
            super().connect()
            return
        if not HAS_UNIX_SOCKETS:
            raise OSError("this system has no Unix domain sockets")
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        self.sock.connect(str(self._address.path))


def _with_tokens(directory: Path) -> list[Running]:
    """Return the programs whose token files for loopback HTTP are in a directory, whether they run or not."""
    found = []
    for path in sorted(directory.glob(f"*{TOKEN_SUFFIX}")):
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            running = Running(parse_control_address(content["url"]), content["token"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            continue  # being written, or not ours
        if isinstance(running.address, LoopbackAddress):
            found.append(running)
    return found


def _answers(running: Running) -> bool:
    assert isinstance(running.address, LoopbackAddress)
    try:
        socket.create_connection((running.address.host, running.address.port), _CONNECT_SECONDS).close()
    except OSError:
        return False
    return True
