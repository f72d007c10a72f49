"""The small HTTP service: over real sockets, with clients that keep to nothing."""

import resource
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from control_sockets import connected, exchange, received
from waiting import wait_until

from busway.errors import LinkDown
from busway.observe.http import HttpLimits, HttpService, bind_tcp, bound_name
from busway.observe.http_messages import BODY_LIMIT, HEAD_LIMIT, HttpRequest, HttpResponse

hanging: list[HttpRequest] = []
"""Requests of /hang, once they are there."""
answers = threading.Event()
"""Set where the answers to /hang may come."""


def echo(request: HttpRequest) -> HttpResponse:
    """Answers with what was asked."""
    if request.path == "/broken":
        raise ValueError("a bug")
    if request.path == "/hang":
        hanging.append(request)
        answers.wait(30)
    return HttpResponse(f"{request.method} {request.path} {request.headers.get('x-one')} ".encode() + request.body)


@contextmanager
def serving(limits: HttpLimits | None = None, **options: object) -> Iterator[str]:
    """A service that echoes, and where it is."""
    bound = bind_tcp("127.0.0.1", 0)
    service = HttpService(bound, echo, limits=limits, **options)  # type: ignore[arg-type]
    answers.clear()
    service.start()
    try:
        yield f"http://{bound_name(bound)}"
    finally:
        answers.set()
        service.stop()


def status_of(answer: bytes) -> int:
    """The status of a raw answer."""
    assert answer.startswith(b"HTTP/1.1 "), answer
    return int(answer[9:12])


def test_a_request_is_answered_and_its_connection_closed() -> None:
    with serving() as address:
        answer = exchange(
            address, b"POST /a?b=c HTTP/1.1\r\nHost: x\r\nX-One:  two \r\nContent-Length: 3\r\n\r\nabcdef"
        )
    head, _, body = answer.partition(b"\r\n\r\n")
    assert body == b"POST /a two abc"
    assert b"Content-Length: 15\r\n" in head
    assert b"Connection: close" in head


def test_a_request_in_pieces_is_put_together() -> None:
    with serving() as address, connected(address) as connection:
        for byte in b"GET /a HTTP/1.1\r\n\r\n":
            connection.sendall(bytes((byte,)))
        assert received(connection).endswith(b"GET /a None ")


@pytest.mark.parametrize(
    ("request_bytes", "status"),
    [
        (b"nonsense\r\n\r\n", 400),
        (b"GET /\r\n\r\n", 400),
        (b"GET http://elsewhere/ HTTP/1.1\r\n\r\n", 400),
        (b"GET / HTTP/2\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nno colon\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost : x\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: x\r\nHost: y\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nContent-Length: -1\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nContent-Length: " + b"9" * 20 + b"\r\n\r\n", 400),
        (f"POST / HTTP/1.1\r\nContent-Length: {BODY_LIMIT + 1}\r\n\r\n".encode(), 413),
        (b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", 411),
        (b"GET /" + b"a" * HEAD_LIMIT + b" HTTP/1.1\r\n\r\n", 431),
        (b"a" * (2 * HEAD_LIMIT + 10), 431),
        (b"GET /broken HTTP/1.1\r\n\r\n", 500),
    ],
)
def test_what_is_no_request_is_refused(request_bytes: bytes, status: int) -> None:
    with serving() as address:
        assert status_of(exchange(address, request_bytes)) == status


def test_a_client_that_sends_half_a_request_is_closed_in_time() -> None:
    with serving(HttpLimits(request_seconds=0.05, seconds=600)) as address, connected(address) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\n")
        assert received(connection) == b""


def test_an_answer_that_does_not_come_is_given_up_in_time() -> None:
    with serving(HttpLimits(seconds=0.05)) as address:
        assert exchange(address, b"GET /hang HTTP/1.1\r\n\r\n") == b""


def test_a_client_that_goes_away_leaves_nothing() -> None:
    with serving() as address:
        for part in (b"", b"GET / HT", b"POST / HTTP/1.1\r\nContent-Length: 5\r\n\r\nab"):
            with connected(address) as connection:
                connection.sendall(part)
        assert status_of(exchange(address, b"GET / HTTP/1.1\r\n\r\n")) == 200


def test_more_connections_than_allowed_are_refused_at_once() -> None:
    hanging.clear()
    with serving(HttpLimits(seconds=30, connections=2)) as address, ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(connected(address)).sendall(b"GET /hang HTTP/1.1\r\n\r\n")
        wait_until(lambda: len(hanging) == 2)
        assert status_of(exchange(address, b"GET / HTTP/1.1\r\n\r\n")) == 503


def test_silent_connections_make_room_for_those_that_ask() -> None:
    with serving(HttpLimits(request_seconds=600)) as address, ExitStack() as stack:
        silent = [stack.enter_context(connected(address)) for _ in range(40)]
        silent[-1].sendall(b"GET /half HTTP/1.1\r\n")
        # Each waits for the end of a thread: on a busy machine the answer is 503 until some have ended.
        wait_until(lambda: status_of(exchange(address, b"GET / HTTP/1.1\r\n\r\n")) == 200)
        assert received(silent[0]) == b""


def test_last_descriptors_of_the_process_are_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    with serving() as address:
        assert status_of(exchange(address, b"GET / HTTP/1.1\r\n\r\n")) == 200
        monkeypatch.setattr(resource, "getrlimit", lambda kind: (8, 8))  # from 4 on they are Modbus'
        assert exchange(address, b"GET / HTTP/1.1\r\n\r\n") == b""


def test_a_connection_that_is_not_admitted_is_closed_unread() -> None:
    with serving(admit=lambda accepted: False) as address:
        assert exchange(address, b"GET / HTTP/1.1\r\n\r\n") == b""


def test_stopping_cuts_off_what_hangs_and_leaves_no_thread_and_no_socket() -> None:
    hanging.clear()
    before = set(threading.enumerate())
    bound = bind_tcp("127.0.0.1", 0)
    address = f"http://{bound_name(bound)}"
    service = HttpService(bound, echo, limits=HttpLimits(seconds=600))
    answers.clear()
    service.start()
    assert status_of(exchange(address, b"GET / HTTP/1.1\r\n\r\n")) == 200
    with connected(address) as silent, connected(address) as asker:
        asker.sendall(b"GET /hang HTTP/1.1\r\n\r\n")
        wait_until(lambda: bool(hanging))
        stopping = threading.Thread(target=service.stop)
        stopping.start()
        assert received(silent) == b""
        assert received(asker) == b""
        assert stopping.is_alive()  # `stop` waits for the answer in progress, although its client has been disconnected
        answers.set()
        stopping.join(10)
    assert set(threading.enumerate()) <= before
    with pytest.raises(ConnectionRefusedError):
        connected(address)


def test_a_service_that_was_never_started_can_be_stopped() -> None:
    bound = bind_tcp("127.0.0.1", 0)
    HttpService(bound, echo).stop()
    assert bound.fileno() == -1


def test_headers_are_known_by_their_names_in_lower_case_and_the_query_is_left_out() -> None:
    seen: list[HttpRequest] = []

    def answer(request: HttpRequest) -> HttpResponse:
        seen.append(request)
        return HttpResponse(b"")

    bound = bind_tcp("127.0.0.1", 0)
    service = HttpService(bound, answer)
    service.start()
    exchange(f"http://{bound_name(bound)}", b"GET /a/b?c HTTP/1.0\r\nHost: x:1\r\nEmpty:\r\n\r\n")
    service.stop()
    assert seen == [HttpRequest("GET", "/a/b", {"host": "x:1", "empty": ""})]


@pytest.mark.parametrize(
    "request_bytes",
    [b"GET / HTTP/1.1\r\nHost: x\r\n", b"GET / HT", b"", b"POST / HTTP/1.1\r\n" + b"Content-Length: 3\r\n\r\nab"],
)
def test_half_a_request_that_ends_is_not_answered(
    request_bytes: bytes, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    with serving() as address, connected(address) as connection:
        connection.sendall(request_bytes)
        connection.shutdown(socket.SHUT_WR)
        assert received(connection) == b""
    assert capsys.readouterr().err == ""
    assert not caplog.records


def test_a_port_that_is_taken_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        name = bound_name(taken)
        with pytest.raises(LinkDown, match=name):
            bind_tcp("127.0.0.1", int(name.rpartition(":")[2]))


def test_of_two_that_bind_one_port_at_once_the_second_is_refused() -> None:
    with bind_tcp("127.0.0.1", 0) as first, pytest.raises(LinkDown, match="cannot listen on"):
        bind_tcp("127.0.0.1", first.getsockname()[1])
