"""Kinds of `LinkDown` and `BadReply`: given at every place that raises them, and right for what really happens.

Also the text of an error without one, such as `TimeoutError`: its kind.
"""

import ast
import errno
import re
import socket
import ssl
from pathlib import Path
from typing import get_args

import pytest

import busway
from busway import errors
from busway.errors import BadReply, LinkClosed, LinkDown, LinkDownKind
from busway.transport.serial.errors import opening_failed
from busway.transport.tcp import network_kind

SOURCE = Path(busway.__file__).parent


def test_each_place_that_makes_such_an_error_says_its_kind() -> None:
    missing = []
    for file in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Name)
                and node.func.id in ("LinkDown", "BadReply")
            ) and "kind" not in {keyword.arg for keyword in node.keywords}:
                missing.append(f"{file.relative_to(SOURCE)}:{node.lineno}")
    assert missing == []


def test_no_place_takes_an_error_without_a_text_for_no_error() -> None:
    """An error object is always true: ``error or "no answer"`` says nothing of one whose text is empty."""
    wrong = []
    for file in SOURCE.rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        names = set(re.findall(r"except .+ as (\w+):", text))
        if not any(re.search(rf"\b{name} or\b", text) for name in names):
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.BoolOp) and isinstance(node.op, ast.Or):
                used = {each.id for each in node.values[:-1] if isinstance(each, ast.Name)}
                wrong += [f"{file.relative_to(SOURCE)}:{node.lineno}: {name}" for name in used & names]
    assert wrong == []


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (socket.gaierror(-2, "unknown"), "unresolved"),
        (ConnectionRefusedError(errno.ECONNREFUSED, ""), "refused"),
        (OSError(errno.EHOSTUNREACH, ""), "unreachable"),
        (TimeoutError(), "timeout"),
        (TimeoutError(errno.ETIMEDOUT, ""), "timeout"),
        (ssl.SSLError(1, "handshake"), "tls"),
        (ConnectionResetError(errno.ECONNRESET, ""), "lost"),
        (OSError(errno.EADDRINUSE, ""), "taken"),
        (PermissionError(errno.EACCES, ""), "local"),
        (OSError("?"), "other"),
    ],
)
def test_the_kind_of_a_network_error(error: Exception, kind: str) -> None:
    assert network_kind(error) == kind
    assert kind in get_args(LinkDownKind)


@pytest.mark.parametrize(
    ("number", "kind"),
    [(errno.ENOENT, "missing"), (errno.EBUSY, "taken"), (errno.EACCES, "local"), (errno.EIO, "lost")],
)
def test_the_kind_of_a_serial_port_that_does_not_open(number: int, kind: str) -> None:
    failure = opening_failed(OSError(number, ""), port="/dev/none")
    assert isinstance(failure, LinkDown)
    assert failure.kind == kind


def test_every_kind_is_explained_where_the_error_is() -> None:
    for error, kinds in ((LinkDown, LinkDownKind), (BadReply, errors.BadReplyKind)):
        assert [kind for kind in get_args(kinds) if f'``"{kind}"``' not in (error.__doc__ or "")] == []


def test_a_refused_connection_keeps_its_kind_while_the_link_waits() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with busway.connect(f"tcp://127.0.0.1:{port}", retries=0) as link:
        for _ in range(2):
            with pytest.raises(LinkDown) as failed:
                link.unit(1).read("4x1")
            assert failed.value.kind == "refused"
    with pytest.raises(LinkClosed) as closed:
        link.unit(1).read("4x1")
    assert closed.value.kind == "closed"


def test_a_port_that_is_not_there_and_a_name_without_address(tmp_path: Path) -> None:
    for url, kind in ((f"rtu://{tmp_path}/none?port_wait=0", "missing"), ("tcp://none.invalid", "unresolved")):
        with busway.connect(url, retries=0) as link, pytest.raises(LinkDown) as failed:
            link.unit(1).read("4x1")
        assert failed.value.kind == kind


def test_a_connection_that_ends_and_replies_that_are_wrong() -> None:
    replies = {
        b"": "lost",
        bytes.fromhex("000100000005010402 0001"): "function",
        bytes.fromhex("0001000000050103030001"): "content",
        bytes.fromhex("000100000000"): "stream",
    }
    for reply, kind in replies.items():
        assert _kind_after(reply) == kind


def _kind_after(reply: bytes) -> str:
    """The kind of the error of a read that a peer answers with these bytes, its transaction put in, and hangs up."""
    import threading

    with socket.create_server(("127.0.0.1", 0)) as listening:

        def answer() -> None:
            peer, _ = listening.accept()
            with peer:
                asked = peer.recv(260)
                peer.sendall(reply and asked[:2] + reply[2:])

        peer = threading.Thread(target=answer)
        peer.start()
        url = f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        with busway.connect(url, preset="passive") as link, pytest.raises(busway.ModbusError) as failed:
            link.unit(1).read("4x1")
        peer.join(10)
    assert isinstance(failed.value, LinkDown | BadReply)
    return failed.value.kind
