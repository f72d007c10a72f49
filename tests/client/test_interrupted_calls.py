"""A thread of a blocking link is interrupted at points at which CPython may do so, while others read and write.

All other calls end, no value is wrong, no write leaves twice, and the link works afterwards with all its slots.
"""

import contextlib
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

import pytest
from interrupting import Interrupt, interrupted

import busway
from busway.client.blocking_link import BlockingLinkDriver
from busway.client.kept_serial_late_replies import KEPT
from busway.framing.rtu import encode_rtu
from busway.pdu.read_items import ReadHoldingRegisters
from busway.session.serial_client import SerialClientSession
from busway.session.serial_late_replies import LateReplies, OwedReply
from busway.testing import faulty_server, known_device

READ = ReadHoldingRegisters(1, 1)
READ.prepare()
pytestmark = [
    pytest.mark.real_time,
    pytest.mark.filterwarnings("ignore:unclosed <socket"),  # of a connection that was just being made
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),  # a point in a finalizer
]
AMPLE = 5.0
"""Seconds within which each call must end; its own time is 1 s."""


class RecordingServer:
    """Answers reads with the address as value, and all else with the request; records the values written."""

    def __init__(self, *, rtu: bool = False) -> None:
        self.written: Counter[int] = Counter()
        self._rtu = rtu
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"{'rtu+tcp' if rtu else 'tcp'}://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=self._talk, args=(connection,), daemon=True).start()

    def _talk(self, connection: socket.socket) -> None:
        size = 8 if self._rtu else 12  # of each request that the tests send
        received = b""
        with connection:
            try:
                while data := connection.recv(4096):
                    received += data
                    while len(received) >= size:
                        frame, received = received[:size], received[size:]
                        connection.sendall(self._answer(frame))
            except OSError:
                return

    def _answer(self, frame: bytes) -> bytes:
        pdu = frame[1:-2] if self._rtu else frame[7:]
        if pdu[0] == 6:
            self.written[int.from_bytes(pdu[3:5], "big")] += 1
        reply = bytes((3, 2)) + pdu[1:3] if pdu[0] == 3 else pdu
        if self._rtu:
            return encode_rtu(frame[0], reply)
        return frame[:4] + (len(reply) + 1).to_bytes(2, "big") + frame[6:7] + reply

    def close(self) -> None:
        self._listener.close()


class World:
    """Links under test, and what their calls brought.

    Attributes:
        confirmed: values of writes that were confirmed.
        wrong: what must not have happened.
    """

    def __init__(self, **options: Any) -> None:
        self.rtu = bool(options.pop("rtu", False))
        links = options.pop("links", 1)
        self.servers = [RecordingServer(rtu=self.rtu) for _ in range(links)]
        self.links = [busway.connect(one.url, shared=False, timeout=1.0, retries=1, **options) for one in self.servers]
        self.confirmed: list[int] = []
        self.wrong: list[str] = []
        self._numbers = count(1)
        self._turns = count()

    def close(self) -> None:
        for link in self.links:
            link.close()
        for server in self.servers:
            server.close()

    def read(self, link: busway.BlockingLink) -> None:
        address = next(self._numbers)
        if (values := link.unit(1).read_holding_registers(address, count=1)) != [address]:
            self.wrong.append(f"{values} for {address}")

    def read_many(self, link: busway.BlockingLink) -> None:
        addresses = [next(self._numbers) for _ in range(3)]
        replies = link.unit(1).execute_many([ReadHoldingRegisters(address, 1) for address in addresses])
        if (values := [reply.registers[0] for reply in replies]) != addresses:
            self.wrong.append(f"{values} for {addresses}")

    def write(self, link: busway.BlockingLink) -> None:
        value = next(self._numbers)
        link.unit(1).write_single_register(0, value)
        self.confirmed.append(value)

    def _go_on(self, link: busway.BlockingLink) -> None:
        """Read and write as another thread, which must get each answer, or an error in time."""
        for ask in (self.read, self.write):
            begin = time.monotonic()
            try:
                ask(link)
            except (busway.LinkDown, busway.WriteOutcomeUnknown):
                pass
            except BaseException as error:
                self.wrong.append(f"{error!r} of a call that was not interrupted")
            if time.monotonic() - begin > AMPLE:
                self.wrong.append("a call took too long")

    def interrupt(self, at: int, ask: Callable[[busway.BlockingLink], object]) -> str:
        """Interrupt ``ask`` at its n-th point. Returns the place; empty if it ended before."""
        place = ""

        def interrupt() -> None:
            nonlocal place
            with contextlib.suppress(busway.ModbusError):
                place = interrupted(lambda: ask(self.links[0]), at)

        victim = threading.Thread(target=interrupt, daemon=True)
        others = [threading.Thread(target=self._go_on, args=(self.links[number],), daemon=True) for number in (0, -1)]
        threads = [victim, *others] if next(self._turns) % 2 else [others[0], victim, others[1]]
        for thread in threads:
            thread.start()
        self._join(threads)
        for link in self.links:  # without another thread that would help it along
            after = threading.Thread(target=self._after, args=(link,), daemon=True)
            after.start()
            self._join([after])
        assert self.wrong == [], f"interrupted at {place}"
        return place

    def _join(self, threads: list[threading.Thread]) -> None:
        for thread in threads:
            thread.join(AMPLE)
            if thread.is_alive():
                self.wrong.append("a call does not end")

    def _after(self, link: busway.BlockingLink) -> None:
        try:
            self.read(link)
        except BaseException as error:
            self.wrong.append(f"{error!r} of a later call")

    def check_end(self) -> None:
        """Check what was written, and that no slot is lost."""
        written = sum((server.written for server in self.servers), Counter())
        assert [value for value, times in written.items() if times > 1] == []
        assert [value for value in self.confirmed if not written[value]] == []
        for link in self.links:
            driver = link._link
            assert driver is not None
            assert driver._calls == set()
            assert driver.session.in_flight == 0
            if not self.rtu:
                assert len(driver.session._free) == link._settings.parameters.max_transactions  # type: ignore[attr-defined]


def sweep(world: World, *asks: Callable[[busway.BlockingLink], object], step: int = 1) -> set[str]:
    """Interrupt calls at one point after another until four in a row end before theirs; return the places."""
    places: set[str] = set()
    at = ended_before = 0
    while ended_before < 4:
        at += step
        place = world.interrupt(at, asks[at % len(asks)])
        ended_before = 0 if place else ended_before + 1
        places.add(place)
    world.check_end()
    return places


WORLDS: dict[str, dict[str, Any]] = {
    "tcp": {"max_transactions": 4},
    "tcp, one connection per request": {"hold": "request"},
    "serial framing": {"rtu": True, "trust_reply_order": True},  # else each later call waits for 2 s
    "one limit for all links": {"scope": "client", "max_transactions": 2, "links": 2},
}


@pytest.fixture(params=WORLDS)
def world(request: pytest.FixtureRequest) -> Iterator[World]:
    made = World(**WORLDS[request.param])
    yield made
    made.close()


def test_interrupt_at_any_point_harms_no_other_call(world: World) -> None:
    assert len(sweep(world, world.read, world.write, world.read_many, step=2)) > 40


def test_interrupt_while_connecting_or_disconnecting_harms_no_other_call(world: World) -> None:
    sweep(world, busway.BlockingLink.disconnect, busway.BlockingLink.connect, step=4)


def test_second_interrupt_while_the_first_is_handled_harms_no_other_call(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted_at_once(*arguments: object) -> None:
        raise Interrupt

    monkeypatch.setattr(BlockingLinkDriver, "_cancel", interrupted_at_once)
    sweep(world, world.read, world.write, world.read_many, step=7)


# Particular calls.


def test_interrupted_read_of_a_silent_peer_keeps_no_slot_of_other_links(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt_wait(*arguments: object) -> bool:
        raise Interrupt

    with faulty_server(known_device(), "wedged") as silent, faulty_server(known_device()) as alive:
        options: Any = {"scope": "client", "shared": False, "timeout": 60.0}
        with busway.connect(silent.endpoint, **options) as dead, busway.connect(alive.endpoint, **options) as link:
            with monkeypatch.context() as patch:
                patch.setattr("busway.client.blocking_link.SocketReadiness.wait", interrupt_wait)
                with pytest.raises(Interrupt):
                    dead.unit(1).read_holding_registers(0, count=1)
            assert link.unit(1).read_holding_registers(7, count=1, deadline=AMPLE) == [7]
            assert not dead.is_connected


def test_interrupted_close_forgets_no_late_reply_and_can_be_repeated() -> None:
    at, place = 0, "somewhere"
    while place:
        at += 1
        server = RecordingServer(rtu=True)
        link = busway.connect(server.url, timeout=AMPLE, retries=0)
        link.unit(1).read_holding_registers(1, count=1)
        driver = link._link
        assert isinstance(driver, BlockingLinkDriver)
        assert isinstance(driver.session, SerialClientSession)
        driver.session.late_replies.of(1).owe(OwedReply(READ, 3, 0.0, 0.0))
        place = interrupted(driver.close, at)
        kept = LateReplies()
        KEPT.hand_over(server.url, kept)
        assert kept.of(1).owed_count >= 1, place
        link.close()
        with pytest.raises(busway.LinkClosed):
            link.unit(1).read_holding_registers(1, count=1)
        server.close()


def test_status_after_an_interrupt_shows_no_request_that_nothing_awaits(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt_receiving(*arguments: object) -> None:
        raise Interrupt

    with faulty_server(known_device()) as server, busway.connect(server.endpoint, timeout=AMPLE) as link:
        driver = link._link
        assert driver is not None
        with monkeypatch.context() as patch:
            patch.setattr("busway.client.blocking_link.BlockingLinkDriver._receive", interrupt_receiving)
            patch.setattr("busway.client.blocking_link.BlockingLinkDriver._cancel", interrupt_receiving)
            with pytest.raises(Interrupt):
                link.unit(1).read_holding_registers(0, count=1)
        status = driver.status()
        assert (status.in_flight, status.queued, status.state) == (0, 0, "down")
