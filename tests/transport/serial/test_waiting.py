"""Waiting for descriptors, low and high ones."""

import fcntl
import os
import resource
import time
from collections.abc import Iterator

import pytest
from fake_port import Pty

from busway.transport.serial.waiting import SELECT_LIMIT, wait_ready


@pytest.fixture(params=["low", "high"])
def near(pty: Pty, request: pytest.FixtureRequest) -> Iterator[int]:
    """The near end, under a number that ``select`` takes and under one that it does not."""
    if request.param == "low":
        yield pty.near
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 2 * SELECT_LIMIT), hard))
    descriptor = fcntl.fcntl(pty.near, fcntl.F_DUPFD_CLOEXEC, SELECT_LIMIT + 1)
    yield descriptor
    os.close(descriptor)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_what_can_be_read_is_told(pty: Pty, near: int) -> None:
    assert wait_ready([near], [], 0) == []
    far = os.open(pty.path, os.O_RDWR | os.O_NOCTTY)
    os.write(far, b"x")
    assert wait_ready([near], [], 5.0) == [near]
    os.close(far)


def test_what_can_be_written_is_told(near: int) -> None:
    assert wait_ready([], [near], None) == [near]


def test_the_time_is_kept(near: int) -> None:
    begun = time.monotonic()
    assert wait_ready([near], [], 0.0015) == []
    assert time.monotonic() - begun >= 0.0015
