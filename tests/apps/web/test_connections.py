"""The connections of the page: those that say nothing lock no other out, and take nothing that Modbus needs."""

import http.client
import resource
import socket
from contextlib import ExitStack

from page_plant import watched

import busway.apps.web.connections
from busway.apps.web.connections import MOST

TOKEN = "a-token-of-some-length"


def silent(stack: ExitStack, host: str, count: int) -> list[socket.socket]:
    """Connections that say nothing."""
    name, _, port = host.rpartition(":")
    return [stack.enter_context(socket.create_connection((name, int(port)), timeout=60)) for _ in range(count)]


def is_closed(link: socket.socket) -> bool:
    """Wait for the end of a connection."""
    try:
        return link.recv(100) == b""
    except ConnectionResetError:
        return True


def test_more_silent_connections_than_there_may_be_lock_no_other_out():
    with watched(token=TOKEN) as plant, ExitStack() as stack:
        links = silent(stack, plant.host, MOST + 10)
        assert plant.exchange("GET", "/")[0] == 200
        assert plant.ask("GET", "/api/simulation", Authorization=f"Bearer {TOKEN}")[0] == 200
        assert all(is_closed(one) for one in links[:10])


def test_head_that_does_not_end_in_its_time_ends_the_connection_and_one_that_is_kept_stays(monkeypatch):
    monkeypatch.setattr(busway.apps.web.connections, "HEAD_SECONDS", 0.2)
    with watched() as plant, ExitStack() as stack:
        kept = http.client.HTTPConnection(plant.host, timeout=60)
        stack.callback(kept.close)
        for _ in range(2):
            nothing, half = silent(stack, plant.host, 2)
            half.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
            kept.request("GET", "/style.css")
            assert kept.getresponse().read()
            assert is_closed(nothing)
            assert is_closed(half)
        again = kept.sock
        assert again is not None
        again.sendall(b"GET / HTTP/1.1\r\n")  # a second head has the same time
        assert is_closed(again)


def test_page_takes_none_of_the_last_descriptors_and_modbus_is_still_served(monkeypatch):
    with watched() as plant, ExitStack() as stack:
        monkeypatch.setattr(resource, "getrlimit", lambda kind: (8, 8))  # from 4 on they are Modbus'
        assert is_closed(silent(stack, plant.host, 1)[0])
        monkeypatch.undo()
        assert plant.exchange("GET", "/")[0] == 200


def test_nonsense_is_answered_each_time_and_logged_once(caplog):
    with watched() as plant, ExitStack() as stack:
        for _ in range(20):
            (one,) = silent(stack, plant.host, 1)
            one.sendall(b"nonsense\r\n\r\n")
            assert one.recv(100).startswith(b"HTTP/1.1 400")
    assert sum("Invalid HTTP request" in one.getMessage() for one in caplog.records) == 1


def test_busy_page_is_answered_before_the_time_of_silent_connections_is_over(monkeypatch):
    monkeypatch.setattr(busway.apps.web.connections, "HEAD_SECONDS", 1000.0)
    with watched() as plant, ExitStack() as stack:
        for _ in range(3):
            silent(stack, plant.host, 60)
            assert plant.exchange("GET", "/")[0] == 200
