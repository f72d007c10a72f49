"""The life of a connection: what becomes of calls when it is made, lost, given up and made anew."""

import math

import pytest

from busway.errors import LinkDown, ModbusError, WriteOutcomeUnknown
from busway.framing.character_times import SerialTiming
from busway.framing.frame_direction import LineRole
from busway.framing.rtu import encode_rtu
from busway.options.client import ClientParameters
from busway.options.lines import FramingParameters
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import WriteSingleRegister
from busway.session.call import Call
from busway.session.connection_life import ConnectionLife
from busway.session.line_framing import line_framing
from busway.session.reconnect import ConnectionEvent, ConnectionState, Reconnect
from busway.session.serial_client import SerialClientSession
from busway.session.tcp_client import TcpClientSession

PAUSE = 8.0
"""Seconds of the first pause, with no part of it left to chance."""


class Link:
    """A life with its conversation, and what it has told."""

    def __init__(self, *, hold: float = math.inf) -> None:
        self.session = TcpClientSession(ClientParameters(max_transactions=4, retries=1), first_transaction=0)
        self.told: list[str] = []
        self.events: list[ConnectionEvent] = []
        reconnect = Reconnect(lambda: 1.0, first=PAUSE, most=4 * PAUSE)
        self.life = ConnectionLife(self.session, reconnect, endpoint="tcp://there", hold=hold, moved=self.moved)

    def moved(self, event: ConnectionEvent, reason: str, news: str) -> None:
        self.events.append(event)
        if news:
            self.told.append(news)

    @property
    def state(self) -> ConnectionState:
        return self.life.reconnect.state

    def up(self, now: float) -> "Link":
        """Connect."""
        assert self.life.may_dial(now)
        self.life.dialled(now)
        self.life.connected(now)
        return self

    def read(self, now: float, *, retries: int = 1) -> Call:
        """Ask for a register, and send it where a connection stands."""
        return self._asked(Call(1, (ReadHoldingRegisters(1, 1),), False, 1.0, retries), now)

    def write(self, now: float) -> Call:
        """Ask to write a register, and send it where a connection stands."""
        return self._asked(Call(1, (WriteSingleRegister(1, 1),), True, 1.0, 0), now)

    def answer(self, now: float) -> None:
        """The reply to the one read in flight."""
        (transaction,) = self.session._pending
        reply = transaction.to_bytes(2, "big") + bytes.fromhex("0000 0005 01 03 02 0001")
        self.session.receive(reply, len(reply), now)
        self.life.replied(now)

    def _asked(self, call: Call, now: float) -> Call:
        self.session.submit(call, now)
        self.session.transmit(now)
        return call


def outcome(call: Call) -> ModbusError | None:
    """The error of a call with one request; None while it is open."""
    (found,) = call.outcomes
    assert found is None or isinstance(found, ModbusError)
    return found


def test_connection_that_is_lost_after_a_reply_is_made_anew_at_once_and_its_reads_wait_for_that() -> None:
    link = Link().up(0.0)
    link.read(0.0)
    link.answer(0.1)
    read, write = link.read(0.2), link.write(0.2)
    link.life.lost(0.3, "the peer reset it")
    assert link.state is ConnectionState.DOWN
    assert link.life.may_dial(0.3)
    assert link.life.refusal(0.3) is None
    assert outcome(read) is None
    assert link.session.queue.size
    assert isinstance(outcome(write), WriteOutcomeUnknown)
    assert link.told == ["up: connected", "down: the peer reset it"]


def test_first_connection_without_a_reply_lets_calls_wait_and_the_second_lets_them_fail_but_for_repeated_ones() -> None:
    link = Link().up(0.0)
    link.read(0.0)
    link.life.lost(1.0, "the peer closed it")
    assert link.state is ConnectionState.BACKING_OFF
    assert link.life.refusal(1.0) is None  # who asks now waits for the next attempt
    waiting = link.read(1.0)
    assert not link.life.may_dial(1.0 + PAUSE / 2)
    link.up(1.0 + PAUSE)
    link.session.transmit(1.0 + PAUSE)
    repeated = link.read(1.0 + PAUSE)
    link.life.lost(2.0 + PAUSE, "the peer closed it")
    assert link.life.down_because == "no connection: the peer closed it, before any reply"
    assert outcome(waiting) is None  # repeated, for the first time
    assert outcome(repeated) is None
    refusal = link.life.refusal(2.0 + PAUSE, unit=7)
    assert refusal is not None
    assert (refusal.endpoint, refusal.unit, refusal.sent) == ("tcp://there", 7, False)
    assert "the next attempt is made in 16.0 s at the earliest" in str(refusal)
    assert refusal.__cause__ is link.life.failure


def test_attempt_that_fails_takes_everything_that_waits_with_it() -> None:
    link = Link()
    read, write = link.read(0.0), link.write(0.0)
    link.life.dialled(0.0)
    link.life.failed(0.5, LinkDown("no connection: nothing listens there"))
    for call in (read, write):
        error = outcome(call)
        assert isinstance(error, LinkDown)
        assert not error.sent
    assert link.session.finished == [read, write]
    assert link.life.refusal(0.5) is not None
    assert link.life.refusal(0.5 + PAUSE) is None


def test_attempt_that_is_interrupted_lets_what_waits_wait() -> None:
    link = Link()
    read = link.read(0.0)
    link.life.dialled(0.0)
    link.life.interrupted(0.5)
    assert outcome(read) is None
    assert link.life.refusal(0.5) is None
    assert not link.life.may_dial(0.5)
    assert link.life.may_dial(0.5 + PAUSE)


def test_next_connection_forgets_why_there_was_none() -> None:
    link = Link()
    link.life.dialled(0.0)
    link.life.failed(0.0, LinkDown("no connection: nothing listens there"))
    assert link.life.down_because
    link.up(PAUSE)
    assert link.life.down_because == ""
    assert link.life.refusal(PAUSE) is None


def test_connection_without_a_request_proves_nothing_when_it_ends() -> None:
    link = Link().up(0.0)
    link.life.lost(1.0, "the peer closed it")
    assert link.state is ConnectionState.DOWN
    assert link.events[-1] is ConnectionEvent.RELEASED
    assert link.life.reconnect.failures == 0


def test_connection_that_was_made_anew_by_us_lets_what_waits_wait_however_often() -> None:
    link = Link()
    now = 0.0
    read = link.read(now)
    for _ in range(3):
        link.up(now)
        link.session.recycle = "3 timeouts in a row"
        link.life.lost(now, "reconnecting after 3 timeouts in a row")
        assert outcome(read) is None
        assert link.life.failure is None
        now += 5 * PAUSE


@pytest.mark.parametrize(
    ("hold", "idle", "reason"),
    [
        (0.0, 0.0, "nothing more is asked"),
        (5.0, 4.9, ""),
        (5.0, 5.0, "unused for 5 s"),
        (math.inf, 1e9, ""),
    ],
)
def test_connection_is_spent_when_it_was_unused_for_as_long_as_it_is_held(
    hold: float, idle: float, reason: str
) -> None:
    link = Link(hold=hold).up(0.0)
    assert link.life.spent(100.0 + idle, last_used=100.0) == reason


def test_release_is_no_loss_and_no_failure() -> None:
    link = Link().up(0.0)
    link.life.released(1.0, "another connection needed the place")
    assert link.session.counters.lost_connections == 0
    assert link.state is ConnectionState.DOWN
    assert link.told[-1] == "down: another connection needed the place"


def test_timeout_makes_a_connection_suspect_and_a_reply_ends_that() -> None:
    link = Link().up(0.0)
    read = link.read(0.0, retries=0)
    assert not link.life.tick(0.9)
    assert link.life.tick(1.0)
    assert isinstance(outcome(read), ModbusError)
    assert link.state is ConnectionState.SUSPECT
    link.life.replied(1.0)  # what came was no valid reply
    assert link.state is ConnectionState.SUSPECT
    link.read(1.0)
    link.answer(1.5)
    assert link.state is ConnectionState.UP


def test_frame_that_answers_nothing_leaves_a_connection_suspect_that_had_a_reply_before() -> None:
    link = Link().up(0.0)
    link.read(0.0)
    link.answer(0.1)
    link.read(0.2, retries=0)
    assert link.life.tick(1.2)
    told = list(link.told)
    foreign = bytes.fromhex("FFFF 0000 0005 01 03 02 0001")  # the identifier of no request
    link.session.receive(foreign, len(foreign), 1.3)
    link.life.replied(1.3)
    assert link.session.counters.foreign_replies == 1
    assert link.state is ConnectionState.SUSPECT
    assert link.told == told
    link.life.lost(1.4, "the peer reset it")
    assert link.state is ConnectionState.DOWN  # no pause: the connection had brought a reply


def test_late_reply_ends_the_suspicion() -> None:
    link = Link().up(0.0)
    link.read(0.0)
    link.answer(0.1)
    link.read(0.2, retries=0)
    (transaction,) = link.session._pending
    assert link.life.tick(1.2)
    late = transaction.to_bytes(2, "big") + bytes.fromhex("0000 0005 01 03 02 0001")
    link.session.receive(late, len(late), 1.3)
    link.life.replied(1.3)
    assert link.session.counters.late_replies == 1
    assert link.state is ConnectionState.UP
    assert link.told[-1] == "up: it answers again"


def test_reply_that_a_silence_completes_ends_the_suspicion_when_the_silence_is_over() -> None:
    line = SerialTiming.of_line(9600)
    framing = line_framing("rtu", LineRole.MASTER, line, FramingParameters(strict_timing=True))
    session = SerialClientSession(ClientParameters(retries=0), framing=framing, jitter=lambda: 0.0)
    life = ConnectionLife(session, Reconnect(lambda: 1.0), endpoint="serial", hold=math.inf, moved=Link().moved)
    life.dialled(0.0)
    life.connected(0.0)

    def ask(unit: int, now: float) -> None:
        life.tick(now)
        session.submit(Call(unit, (ReadHoldingRegisters(1, 1),), False, 1.0, 0), now)
        assert session.transmit(now)

    ask(1, 1.0)
    assert life.tick(2.5)
    life.tick(4.0)
    ask(2, 5.0)
    life.tick(5.1)
    now = 5.1
    for byte in encode_rtu(2, bytes.fromhex("03 02 0001")):
        now += line.character
        session.receive(bytes((byte,)), 1, now)
        life.replied(now)
    assert life.reconnect.state is ConnectionState.SUSPECT  # a character within t3.5 would spoil it
    assert not life.tick(now + line.t3_5 * 1.1)
    assert life.reconnect.state is ConnectionState.UP


def test_end_of_the_link_fails_what_waits() -> None:
    link = Link()
    read = link.read(0.0)
    link.life.ended(1.0)
    error = outcome(read)
    assert isinstance(error, LinkDown)
    assert error.message == "the link was closed"
