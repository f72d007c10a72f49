"""The waits of a blocking link at its socket, with ``poll`` and without."""

import select
import socket
from collections.abc import Iterator

import pytest

from busway.client.readiness import SocketReadiness


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    one, other = socket.socketpair()
    with one, other:
        yield one, other


@pytest.fixture(params=["poll", "select"])
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """A system that has ``poll``, and one that lacks it."""
    if request.param == "select":
        monkeypatch.delattr(select, "poll", raising=False)


@pytest.mark.usefixtures("system")
def test_a_wait_ends_when_bytes_are_there_or_can_be_sent(pair: tuple[socket.socket, socket.socket]) -> None:
    one, other = pair
    poll = SocketReadiness(one)
    assert not poll.wait(one, 0.0, False)
    assert poll.wait(one, 60.0, True)
    other.send(b"x")
    assert poll.wait(one, 60.0, False)


@pytest.mark.parametrize("writes", [False, True])
def test_without_poll_a_wait_at_a_socket_that_another_thread_has_closed_is_over(
    monkeypatch: pytest.MonkeyPatch, pair: tuple[socket.socket, socket.socket], writes: bool
) -> None:
    monkeypatch.delattr(select, "poll", raising=False)
    one, _ = pair
    poll = SocketReadiness(one)
    one.close()
    assert not poll.wait(one, 0.0, writes)
