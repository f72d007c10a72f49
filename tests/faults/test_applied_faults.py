"""When a fault strikes: by unit, function, address, chance, schedule and switch."""

import pytest

from busway import STANDARD, ConfigError
from busway.testing import SILENCE, Contact, Exchange, Fault, Faults, Schedule, Selection

READ = bytes.fromhex("03 000A 0005")  # holding registers 10…14
WRITE = bytes.fromhex("06 0014 0001")  # holding register 20


def _exchange(pdu: bytes = READ, *, unit: int = 1, now: float = 0.0) -> Exchange:
    return Exchange(Contact(0.0), 1, unit, pdu, STANDARD.decode_request(pdu), now)


def _strikes(faults: Faults, exchange: Exchange) -> bool:
    return bool(faults.strike(exchange))


@pytest.mark.parametrize(
    ("selection", "read", "write"),
    [
        (Selection(), True, True),
        (Selection(units={1}), True, True),
        (Selection(units={2, 3}), False, False),
        (Selection(functions={3, 4}), True, False),
        (Selection(addresses=range(14, 20)), True, False),
        (Selection(addresses=range(15, 20)), False, False),
        (Selection(addresses=range(11)), True, False),
        (Selection(addresses=range(20, 21)), False, True),
        (Selection(units={1}, functions={6}, addresses=range(100)), False, True),
        (Selection(probability=0.0), False, False),
    ],
)
def test_selection_means_units_functions_and_touched_addresses(selection: Selection, read: bool, write: bool) -> None:
    faults = Faults()
    faults.add(Fault("x"), selection)
    assert _strikes(faults, _exchange(READ)) is read
    assert _strikes(faults, _exchange(WRITE)) is write


def test_request_without_addresses_is_not_meant_where_addresses_are_chosen() -> None:
    faults = Faults()
    faults.add(Fault("x"), Selection(addresses=range(65_536)))
    for pdu in ("11", "41 0000", "03 0000", "03 0000 0000"):
        assert not _strikes(faults, _exchange(bytes.fromhex(pdu))), pdu


def test_switch_and_count() -> None:
    faults = Faults()
    applied = faults.add(Fault("x"))
    assert _strikes(faults, _exchange())
    applied.off()
    assert not _strikes(faults, _exchange())
    applied.on()
    assert _strikes(faults, _exchange())
    assert (applied.name, applied.label, applied.struck) == ("x", "x", 0)
    faults.remove(applied)
    faults.remove(applied)
    assert not _strikes(faults, _exchange())
    assert list(faults) == []


def test_fault_lasts_as_long_as_its_block() -> None:
    faults = Faults()
    with faults.during(Fault("x")) as applied:
        assert _strikes(faults, _exchange())
    assert not _strikes(faults, _exchange())
    assert not applied.struck


@pytest.mark.parametrize(
    ("schedule", "times"),
    [
        (Schedule(after=1), [1, 2, 3, 4, 5, 6, 7, 8, 9]),
        (Schedule(lasts=3), [0, 1, 2]),
        (Schedule(after=2, lasts=2), [2, 3]),
        (Schedule(after=1, lasts=1, every=3), [1, 4, 7]),
        (Schedule(lasts=2, every=4), [0, 1, 4, 5, 8, 9]),
        (Schedule(skip=2), [2, 3, 4, 5, 6, 7, 8, 9]),
        (Schedule(times=3), [0, 1, 2]),
        (Schedule(skip=1, times=2), [1, 2]),
        (Schedule(after=3, skip=1, times=2), [4, 5]),
    ],
)
def test_schedule_counts_seconds_and_requests_from_the_first_one_on(schedule: Schedule, times: list[int]) -> None:
    faults = Faults()
    faults.add(Fault("x"), Selection(schedule=schedule))
    assert [second for second in range(10) if _strikes(faults, _exchange(now=100.0 + second))] == times


def test_schedule_begins_anew_when_it_is_switched_on_again() -> None:
    faults = Faults()
    applied = faults.add(Fault("x"), Selection(schedule=Schedule(times=1)))
    assert [_strikes(faults, _exchange()) for _ in range(3)] == [True, False, False]
    applied.on()
    assert [_strikes(faults, _exchange()) for _ in range(3)] == [True, False, False]


def test_same_seed_strikes_the_same_requests_and_another_one_others() -> None:
    def pattern(seed: int, *before: str) -> list[bool]:
        faults = Faults(seed)
        for name in before:
            faults.add(Fault(name), Selection(probability=0.5))
        applied = faults.add(Fault("x"), Selection(probability=0.5))
        return [any(one is applied for one, _ in faults.strike(_exchange())) for _ in range(64)]

    assert pattern(1) == pattern(1)
    assert pattern(1) != pattern(2)
    assert 16 < sum(pattern(1)) < 48


@pytest.mark.parametrize(
    "make",
    [
        lambda: Selection(probability=1.1),
        lambda: Selection(probability=-0.1),
        lambda: Selection(addresses=range(5, 5)),
        lambda: Selection(addresses=range(0, 10, 2)),
        lambda: Selection(units=1),  # type: ignore[arg-type]
        lambda: Selection(units={256}),
        lambda: Selection(units="1-3"),  # type: ignore[arg-type]
        lambda: Selection(functions=[0]),
        lambda: Schedule(after=-1),
        lambda: Schedule(times=-1),
        lambda: Schedule(every=2),
        lambda: Schedule(lasts=3, every=2),
    ],
)
def test_choice_that_cannot_be_is_refused(make: object) -> None:
    assert callable(make)
    with pytest.raises(ConfigError):
        make()


def test_connection_is_admitted_only_if_every_fault_does_and_closes_at_the_earliest_moment() -> None:
    faults = Faults()
    contact = Contact(10.0, others=1)
    assert faults.admit(contact)
    assert faults.closes_at(contact, 10.0) is None
    faults.add(Fault("a", closes_at=lambda one: one.opened + 5))
    faults.add(Fault("b", closes_at=lambda one: one.opened + 3))
    faults.add(Fault("c", closes_at=lambda one: None))
    assert faults.closes_at(contact, 10.0) == 13.0
    refusing = faults.add(Fault("d", admits=lambda one: not one.others))
    assert not faults.admit(contact)
    refusing.off()
    assert faults.admit(contact)


def test_silence_is_no_answer_at_all() -> None:
    assert SILENCE == b""


def test_schedule_says_when_it_changes_next() -> None:
    assert Schedule().next_change(5) is None
    once = Schedule(after=14, lasts=4)
    assert [once.next_change(at) for at in (0, 14, 17, 18)] == [14, 18, 18, None]
    again = Schedule(after=1, lasts=2, every=10)
    assert [again.next_change(at) for at in (0, 1, 3, 11, 12)] == [1, 3, 11, 13, 13]
