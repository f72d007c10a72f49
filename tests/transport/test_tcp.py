"""What network errors say, for an operator."""

import errno
import os
import socket

import pytest

from busway.transport.tcp import network_reason


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EADDRINUSE, "the port is taken"),
        (errno.EACCES, "ports below 1024 belong to privileged programs"),
        (errno.ECONNREFUSED, "nothing listens there"),
        (errno.EADDRNOTAVAIL, "the local address does not exist"),
    ],
)
def test_what_the_system_says_becomes_a_sentence_without_its_number(number: int, words: str) -> None:
    said = network_reason(OSError(number, f"error while attempting to bind: {os.strerror(number)}"))
    assert words in said
    assert "Errno" not in said


def test_what_is_not_known_is_said_as_it_came() -> None:
    assert network_reason(OSError(errno.EIO, "not known")) == f"[Errno {errno.EIO}] not known"


def test_a_name_that_is_not_known_and_a_connection_that_takes_too_long() -> None:
    assert network_reason(socket.gaierror(-2, "no such name")) == "the host name cannot be resolved (no such name)"
    assert network_reason(TimeoutError()) == "no connection within the connect timeout"
