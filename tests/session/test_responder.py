"""The way of a late reply: once, to the client that asked."""

import pytest

from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.message import Message
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import SILENCE, ClientIdentity, Deferral, RequestContext


def test_a_late_reply_goes_its_way_once() -> None:
    gone: list[tuple[int, Message | Deferral]] = []
    context = RequestContext(
        unit=1,
        function=3,
        diagnostics=CommunicationState(),
        transaction=7,
        finish=lambda who, reply: gone.append((who.transaction, reply)),
    )
    assert not context.replied
    context.refuse(6)
    context.refuse(4)
    context.reply(SILENCE)
    assert context.replied
    assert gone == [(7, ExceptionResponse(3, 6))]


def test_a_context_without_a_way_back_takes_replies_and_does_nothing() -> None:
    context = RequestContext(unit=1, function=3, diagnostics=CommunicationState())
    assert context.replied
    context.refuse(6)


def test_a_late_reply_is_seen_by_all_who_watch_and_once() -> None:
    order: list[str] = []
    context = RequestContext(
        unit=1, function=3, diagnostics=CommunicationState(), finish=lambda who, reply: order.append("gone")
    )
    context.watch(lambda reply: order.append("first"))
    context.watch(lambda reply: order.append("second"))
    assert not context.replied
    context.refuse(6)
    context.refuse(6)
    assert order == ["first", "second", "gone"]


def test_who_watches_learns_once_that_no_reply_can_be_given() -> None:
    context = RequestContext(unit=1, function=3, diagnostics=CommunicationState(), finish=lambda who, reply: None)
    seen: list[object] = []
    context.watch(seen.append)
    context.abandon()
    context.watch(seen.append)
    context.refuse(6)
    assert seen == [None]


@pytest.mark.parametrize(
    ("address", "peer", "host"),
    [
        (("10.0.0.7", 40000), "10.0.0.7:40000", "10.0.0.7"),
        (("fe80::1", 40000, 0, 0), "[fe80::1]:40000", "fe80::1"),
        (("::ffff:10.0.0.7", 40000, 0, 0), "[::ffff:10.0.0.7]:40000", "10.0.0.7"),
        ("10.0.0.7:40000", "10.0.0.7:40000", "10.0.0.7"),
        ("rtu:///dev/ttyS0", "rtu:///dev/ttyS0", "rtu:///dev/ttyS0"),
        ("", "", ""),
    ],
)
def test_a_client_is_named_by_its_socket_address_or_its_line(
    address: str | tuple[object, ...], peer: str, host: str
) -> None:
    client = ClientIdentity(address)
    assert (client.host, client.peer, client.host) == (host, peer, host)
