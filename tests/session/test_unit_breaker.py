"""Dead units cost a line no more than a probe, and come back by themselves."""

import pytest
from virtual_bus import Bus, MasterEnd

from busway.errors import ConfigError, ModbusError, NoReply, UnitSuspended
from busway.framing.rtu import encode_rtu
from busway.options.client import ClientParameters
from busway.options.lines import BreakerParameters
from busway.pdu.read_items import ReadHoldingRegisters
from busway.server.device import Device
from busway.session.unit_breaker import Breakers, BreakerState

READ = ReadHoldingRegisters(0, 10)


def breakers(**options: float) -> Breakers:
    return Breakers(BreakerParameters(**options), lambda: 1.0)  # type: ignore[arg-type]


# The breaker by itself.


def test_three_timeouts_in_a_row_open_it_and_a_reply_between_starts_the_count_anew() -> None:
    units = breakers()
    assert [units.timed_out(5, 1.0), units.timed_out(5, 2.0)] == [False, False]
    units.answered(5)
    assert [units.timed_out(5, 3.0), units.timed_out(5, 4.0), units.timed_out(5, 5.0)] == [False, False, True]
    assert units.state(5) is BreakerState.OPEN
    assert units.suspended_for(5, 5.0) == pytest.approx(3.0)
    assert units.suspended_for(6, 5.0) is None


def test_pause_doubles_with_each_failed_probe_up_to_the_longest() -> None:
    units = breakers(first_pause=1.0, longest_pause=5.0)
    now, pauses = 0.0, []
    for _ in range(3):
        units.timed_out(5, now)
    for _ in range(4):
        pause = units.suspended_for(5, now)
        assert pause is not None
        pauses.append(pause)
        now += pause
        assert units.suspended_for(5, now) is None
        assert units.asked(5, now, 1.0) == 0.1
        assert units.is_probing(5)
        now += 0.1
        assert units.timed_out(5, now)
    assert pauses == pytest.approx([1.0, 2.0, 4.0, 5.0])


def test_jitter_cuts_pauses_and_never_stretches_them() -> None:
    for jitter, pause in ((0.0, 2.7), (1.0, 3.0)):
        units = Breakers(BreakerParameters(), lambda jitter=jitter: jitter)  # type: ignore[misc]
        for _ in range(3):
            units.timed_out(5, 0.0)
        assert units.suspended_for(5, 0.0) == pytest.approx(pause)


def test_probe_waits_twice_what_is_usual_and_never_longer_than_the_request() -> None:
    units = breakers()
    for _ in range(3):
        units.timed_out(5, 0.0)
    assert units.asked(5, 4.0, 1.0, 0.2) == pytest.approx(0.4)
    assert units.asked(5, 4.0, 0.05, 0.2) == pytest.approx(0.05)
    assert units.asked(6, 4.0, 1.0, 0.2) == 1.0


def test_reply_closes_it_and_says_so() -> None:
    units = breakers()
    for _ in range(3):
        units.timed_out(5, 0.0)
    assert units.answered(5)
    assert not units.answered(5)
    assert units.states() == {}


def test_probe_whose_port_was_lost_is_as_if_not_made() -> None:
    units = breakers()
    for _ in range(3):
        units.timed_out(5, 0.0)
    units.asked(5, 3.0, 1.0)
    units.not_decided(5)
    assert units.state(5) is BreakerState.OPEN
    assert units.suspended_for(5, 3.2) is None


def test_zero_switches_it_off() -> None:
    units = breakers(open_after=0)
    assert not any(units.timed_out(5, float(number)) for number in range(50))


@pytest.mark.parametrize(
    "options", [{"open_after": -1}, {"first_pause": 0}, {"longest_pause": 1.0}, {"probe_timeout": 0}]
)
def test_impossible_settings_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        BreakerParameters(**options)  # type: ignore[arg-type]


# On a line.


class Poller:
    """Asks one unit again and again, and after a pause where it is not asked."""

    def __init__(self, master: MasterEnd, unit: int) -> None:
        self.outcomes: list[tuple[float, object]] = []
        self._master = master
        self._unit = unit
        self._stopped = False
        self._waits_until: float | None = None
        self._ask()

    def ask_again(self) -> None:
        """Ask, if it was told to wait and has done so."""
        if self._waits_until is not None and self._master.bus.now >= self._waits_until:
            self._waits_until = None
            self._ask()

    def stop(self) -> None:
        self._stopped = True

    def good_between(self, begin: float, end: float) -> int:
        return sum(begin <= time < end and not isinstance(one, ModbusError) for time, one in self.outcomes)

    def _ask(self) -> None:
        if self._stopped:
            return
        try:
            self._master.ask(self._unit, READ, caller=self._unit, then=lambda question: self._ended(question.outcome))
        except UnitSuspended as error:
            self.outcomes.append((self._master.bus.now, error))
            self._waits_until = self._master.bus.now + 0.1

    def _ended(self, outcome: object) -> None:
        self.outcomes.append((self._master.bus.now, outcome))
        self._ask()


def run(bus: Bus, seconds: float, pollers: list[Poller]) -> None:
    """Let time pass, and let those ask again who were told to wait."""
    end = bus.now + seconds
    while bus.now < end:
        bus.run(0.1)
        for one in pollers:
            one.ask_again()


def test_three_dead_units_of_ten_leave_the_others_19_parts_of_20_of_the_line() -> None:
    """After the first 10 s, against a line whose dead units are not asked at all; timeout 1 s."""

    def served(units: range) -> int:
        bus = Bus(8)
        master = bus.master(parameters=ClientParameters(timeout=1.0))
        for unit in range(1, 8):
            bus.servers({unit: Device(holding_registers=10)})
        pollers = [Poller(master, unit) for unit in units]
        run(bus, 70.0, pollers)
        return sum(one.good_between(10.0, 70.0) for one in pollers)

    alone, together = served(range(1, 8)), served(range(1, 11))
    assert together >= 0.95 * alone, (together, alone, together / alone)


def test_revived_unit_is_served_within_ten_seconds() -> None:
    bus = Bus(9)
    master = bus.master(parameters=ClientParameters(timeout=1.0))
    for unit in range(1, 8):
        bus.servers({unit: Device(holding_registers=10)})
    bus.servers({8: Device(holding_registers=10)})
    for revived_at in (20.0, 63.0):  # after short pauses, and after the longest
        bus.line.cut(8)
        pollers = [Poller(master, unit) for unit in range(1, 9)]
        run(bus, revived_at, pollers)
        assert master.session.breakers.state(8) is not BreakerState.CLOSED
        bus.line.mend(8)
        begun = bus.now
        run(bus, 10.0, pollers)
        assert pollers[-1].good_between(begun, begun + 10.0) > 0
        for one in pollers:
            one.stop()


def test_dead_unit_fails_at_once_while_it_is_given_up_and_says_when_it_is_asked_again() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.2, retries=2))
    assert isinstance(master.get(5, READ), NoReply)
    with pytest.raises(UnitSuspended, match="asked again in") as caught:
        master.ask(5, READ)
    assert 0 < caught.value.next_probe <= 3.0
    assert master.session.counters.suspended == 1
    assert len(master.sent) == 3


def test_what_waits_for_a_unit_is_told_when_it_is_given_up() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.2, retries=2))
    questions = [master.ask(5, READ, caller=caller) for caller in range(4)]
    bus.run(until=lambda: all(question.done for question in questions))
    assert isinstance(questions[0].outcome, NoReply)
    assert len(master.sent) == 3
    assert sum(isinstance(question.outcome, UnitSuspended) for question in questions) == 3


def test_late_reply_closes_the_breaker() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.2, retries=2))
    master.get(5, READ)
    assert master.session.breakers.state(5) is BreakerState.OPEN
    bus.line.inject(encode_rtu(5, b"\x03\x14" + bytes(20)), bus.now + 0.01)
    bus.run(0.2)
    assert master.session.breakers.state(5) is BreakerState.CLOSED
