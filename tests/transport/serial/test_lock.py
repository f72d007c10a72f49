"""Who holds a port."""

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest
from fake_port import FakeDriver, Pty, taken

from busway.transport.serial.lock import TIOCEXCL, TIOCNXCL, Holder, admit_others, holder_of, refuse_others

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux lists who holds what")

LOCKING_PROGRAM = """
import fcntl, os, sys
descriptor = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
if sys.argv[2] == "lock":
    fcntl.flock(descriptor, fcntl.LOCK_EX)
print("held", flush=True)
sys.stdin.read()
"""


@on_linux
@pytest.mark.parametrize("how", ["lock", "open"])
def test_another_program_is_named_with_its_command(pty: Pty, how: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", LOCKING_PROGRAM, pty.path, how], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == b"held\n"
        holder = holder_of(pty.path)
        program.communicate(b"")
    assert holder is not None
    assert holder.process == program.pid
    assert sys.executable in holder.command
    assert str(program.pid) in str(holder)


@on_linux
def test_this_process_is_named_as_such(pty: Pty) -> None:
    descriptor = os.open(pty.path, os.O_RDWR | os.O_NOCTTY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        holder = holder_of(pty.path)
    finally:
        os.close(descriptor)
    assert holder is not None
    assert holder.ourselves
    assert "this program itself" in str(holder)


def test_a_port_that_is_not_held_has_no_holder(pty: Pty) -> None:
    assert holder_of(pty.path) is None


def test_a_port_that_is_not_there_has_no_holder() -> None:
    assert holder_of("/dev/no-such-port") is None


def test_where_nothing_is_listed_the_holder_stays_unnamed(pty: Pty, tmp_path: Path) -> None:
    assert holder_of(pty.path, processes=tmp_path) is None
    assert holder_of(pty.path, processes=tmp_path / "missing") is None


def test_a_holder_whose_command_may_not_be_seen_is_named_by_number() -> None:
    assert str(Holder(4711)) == "process 4711"
    assert str(Holder(4711, "mbpoll /dev/ttyUSB0")) == "process 4711 (mbpoll /dev/ttyUSB0)"


def test_others_are_refused_and_admitted_again() -> None:
    driver = FakeDriver()
    driver.answers = {TIOCEXCL: taken, TIOCNXCL: taken}
    refuse_others(3, driver)
    admit_others(3, driver)
    assert driver.requests() == [TIOCEXCL, TIOCNXCL]


def test_a_port_that_vanished_admits_no_user() -> None:
    admit_others(3, FakeDriver(refusal=5))
