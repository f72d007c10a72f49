"""A thread interrupted anywhere in a blocking call: calls of others end, values are right, each write leaves once."""

import contextlib
import ctypes
import random
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest

import busway
from busway.framing.rtu import encode_rtu

pytestmark = pytest.mark.real_time

LASTS = 1.5
"""Seconds for which the victim is interrupted."""
LONGEST = 3.0
"""Seconds within which each call ends; its deadline is two."""
OPTIONS: dict[str, Any] = {
    "timeout": 0.5,
    "retries": 1,
    "deadline": 2.0,
    "reconnect_first": 0.01,
    "reconnect_most": 0.05,
}


class InterruptError(BaseException):
    """What ends the victim's calls, as Ctrl-C does."""


class Recorder:
    """A device whose register *n* holds *n*; remembers what was written. Frames are of Modbus TCP or RTU."""

    def __init__(self, *, is_rtu: bool) -> None:
        self.written: Counter[int] = Counter()
        self.is_rtu: bool = is_rtu
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(5)

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                threading.Thread(target=self._talk, args=(connection,), daemon=True).start()

    def _talk(self, connection: socket.socket) -> None:
        size = 8 if self.is_rtu else 12
        kept = b""
        with connection, contextlib.suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while got := connection.recv(300):
                kept += got
                while len(kept) >= size:
                    frame, kept = kept[:size], kept[size:]
                    reply = self._answer(frame)
                    middle = len(reply) // 2
                    connection.sendall(reply[:middle])  # a reply comes in two parts
                    connection.sendall(reply[middle:])

    def _answer(self, frame: bytes) -> bytes:
        unit, pdu = (frame[0], frame[1:6]) if self.is_rtu else (frame[6], frame[7:12])
        if pdu[0] == 6:
            self.written[int.from_bytes(pdu[3:5], "big")] += 1
            reply = pdu
        elif pdu[0] == 8:
            reply = pdu  # the link asks it, to tell late replies apart
        else:
            reply = bytes((3, 2)) + pdu[1:3]
        if self.is_rtu:
            return encode_rtu(unit, reply)
        return frame[:4] + (len(reply) + 1).to_bytes(2, "big") + bytes((unit,)) + reply


@pytest.fixture(autouse=True)
def quiet_interpreter(monkeypatch: pytest.MonkeyPatch) -> None:
    """An interrupt may come in a finalizer, or behind a call; Python reports that, and it is not about links."""
    monkeypatch.setattr("sys.unraisablehook", lambda _: None)
    monkeypatch.setattr("threading.excepthook", lambda _: None)


@pytest.fixture
def recorder(request: pytest.FixtureRequest) -> Iterator[tuple[str, Recorder]]:
    found = Recorder(is_rtu=request.param == "rtu+tcp")
    yield f"{request.param}://127.0.0.1:{found.port}", found
    found.close()


class Caller(threading.Thread):
    """A thread that reads and writes on a link until the test ends; its writes have values of its own."""

    def __init__(self, link: busway.BlockingLink, number: int, until: float) -> None:
        super().__init__(daemon=True)
        self.link, self.number, self.until = link, number, until
        self.is_calling = False
        self.longest = 0.0
        self.wrong: list[object] = []
        self.done: set[int] = set()
        self.reads = 0
        self._next = 0

    def run(self) -> None:
        with contextlib.suppress(RecursionError):
            try:
                while time.monotonic() < self.until:
                    with contextlib.suppress(InterruptError):
                        self._call()
                    self.is_calling = False
            except InterruptError:  # it came behind a call
                self.run()

    def _call(self) -> None:
        unit = self.link.unit(1)
        self._next += 1
        value = 10_000 * self.number + self._next
        begun = time.monotonic()
        self.is_calling = True
        try:
            if self._next % 3 == 0:
                unit.write_single_register(1, value)
                self.done.add(value)
            elif (read := unit.read_holding_registers(value, count=1)) != [value]:
                self.wrong.append((value, read))
            else:
                self.reads += 1
        except busway.ModbusError:
            pass  # a connection was lost: said, not hidden
        self.longest = max(self.longest, time.monotonic() - begun)


def interrupt_at_random(victim: Caller, *, seed: int) -> int:
    """Interrupt a thread again and again while it calls. Returns how often."""
    chosen, count = random.Random(seed), 0
    while time.monotonic() < victim.until:
        time.sleep(chosen.random() * 0.003)
        if victim.is_calling and victim.is_alive():
            count += 1
            ctypes.pythonapi.PyThreadState_SetAsyncExc(
                ctypes.c_ulong(victim.ident or 0), ctypes.py_object(InterruptError)
            )
    return count


def check(callers: list[Caller], recorder: Recorder) -> None:
    for caller in callers:
        caller.join(LONGEST + 2)
        assert not caller.is_alive(), f"a call of thread {caller.number} does not end"
        assert caller.longest < LONGEST
        assert caller.wrong == []
        assert caller.reads > 5 or caller.number == 0 or recorder.is_rtu  # a line that owes replies is slow
        assert all(recorder.written[value] == 1 for value in caller.done)
    assert max(recorder.written.values()) == 1


@pytest.mark.parametrize(
    ("recorder", "options"),
    [
        ("tcp", {}),
        ("tcp", {"max_transactions": 4}),
        ("tcp", {"hold": "request"}),
        ("rtu+tcp", {}),
        ("rtu+tcp", {"hold": "request"}),
    ],
    indirect=["recorder"],
)
def test_calls_of_other_threads_end_with_right_values_and_no_write_leaves_twice(
    recorder: tuple[str, Recorder], options: dict[str, Any]
) -> None:
    url, device = recorder
    until = time.monotonic() + LASTS
    with busway.connect(url, **OPTIONS, **options) as link:
        callers = [Caller(link, number, until) for number in range(3)]
        for caller in callers:
            caller.start()
        assert interrupt_at_random(callers[0], seed=1) > 10
        check(callers, device)
        assert link.unit(1).read_holding_registers(5, count=1, deadline=2.0) == [5]


@pytest.mark.parametrize("recorder", ["tcp"], indirect=True)
def test_links_of_one_scope_lose_no_slot(recorder: tuple[str, Recorder]) -> None:
    url, device = recorder
    until = time.monotonic() + LASTS
    with (
        busway.connect(url, shared=False, scope="client", **OPTIONS) as first,
        busway.connect(url, shared=False, scope="client", **OPTIONS) as second,
    ):
        callers = [Caller(link, number, until) for number, link in enumerate((first, second, first))]
        for caller in callers:
            caller.start()
        assert interrupt_at_random(callers[0], seed=2) > 10
        check(callers, device)
        for link in (first, second):
            assert link.unit(1).read_holding_registers(5, count=1, deadline=2.0) == [5]


def test_a_slot_of_a_cancelled_request_comes_back_though_no_thread_uses_its_link() -> None:
    silent = socket.create_server(("127.0.0.1", 0))
    device = Recorder(is_rtu=False)
    options = {**OPTIONS, "scope": "client", "retries": 0}
    with (
        busway.connect(f"tcp://127.0.0.1:{silent.getsockname()[1]}", **options) as mute,
        busway.connect(f"tcp://127.0.0.1:{device.port}", **options) as link,
    ):
        victim = Caller(mute, 0, 0.0)
        victim.until = time.monotonic() + 0.3
        victim.start()
        while not victim.is_calling:
            time.sleep(0.001)
        interrupt_at_random(victim, seed=3)
        victim.join(5)
        assert link.unit(1).read_holding_registers(5, count=1, deadline=2.0) == [5]
    silent.close()
    device.close()
