"""The checker of the chaos test finds each thing that may be wrong, and nothing where all is well."""

from dataclasses import replace

import pytest
from fleet_checker import Bounds, Frame, Logs, Owned, Stored, Unread, judged, taken

BOUNDS = Bounds(period=1.0, takeover=4.0, unrecorded=2.0)


def well() -> Logs:
    """One link: ``a`` has it for ten seconds and dies, ``b`` takes it four seconds later, and starts one write."""
    logs = Logs(begin=0.0, end=20.0)
    for second in [*range(10), *range(14, 20)]:
        name = "a" if second < 10 else "b"
        logs.frames.append(Frame(second, "hall", name, is_write=False, value=second + 1))
        logs.stored.append(Stored(name, "hall", second + 1, second))
    logs.frames.append(Frame(19.5, "hall", "b", is_write=True, value=77))
    logs.owned = [Owned("a", "hall", (1, 5), -1.0, None), Owned("b", "hall", (1, 9), 13.9, None)]
    logs.unread = [Unread("b", "hall", 10.0, 13.9)]
    logs.committed = {("hall", 3), ("hall", 15)}
    logs.sunk = {("hall", each.value): 1 for each in logs.stored}
    logs.sunk_until = 20.0
    logs.faults = [9.5]
    return logs


def late(count: int) -> list[Frame]:
    return [Frame(16.5 + number / 10, "hall", "a", is_write=False, value=90 + number) for number in range(count)]


def with_frames(logs: Logs, *frames: Frame) -> Logs:
    return replace(logs, frames=sorted([*logs.frames, *frames], key=lambda each: each.at))


def test_nothing_is_found_where_all_is_well() -> None:
    assert judged(well(), BOUNDS) == []
    assert taken(well(), "a", 9.5, 20.0) == {"hall"}
    assert not taken(well(), "a", 9.5, 13.0)
    assert not taken(well(), "b", 9.5, 20.0)


def test_one_late_transaction_of_the_former_owner_is_allowed_and_two_are_two_masters() -> None:
    assert judged(with_frames(well(), *late(1)), BOUNDS) == []
    assert "hall by a in (1, 5) after (1, 9)" in judged(with_frames(well(), *late(2)), BOUNDS)[0]


def broken(what: str) -> Logs:
    logs = well()
    match what:
        case "no epoch":
            return replace(logs, owned=logs.owned[1:])
        case "lost":
            return replace(logs, stored=[each for each in logs.stored if each.value != 3], sunk=None)
        case "twice":
            return replace(logs, stored=[*logs.stored, Stored("b", "hall", 3, 17.0)])
        case "invented":
            return replace(logs, stored=[*logs.stored, Stored("b", "hall", 1000, 17.0)], sunk=None)
        case "not sunk":
            return replace(logs, sunk={key: 1 for key in logs.sunk or () if key[1] != 3})
        case "sunk twice":
            return replace(logs, sunk={**(logs.sunk or {}), ("hall", 3): 2})
        case "written twice":
            return with_frames(logs, Frame(19.6, "hall", "b", is_write=True, value=77))
        case "written although refused":
            return replace(logs, not_executed={77})
        case "silent":
            return replace(logs, faults=[], frames=[each for each in logs.frames if not 3 < each.at < 10], sunk=None)
        case "silent at the end":
            return replace(logs, frames=[each for each in logs.frames if each.at < 15])
        case "not recorded":
            return replace(logs, unread=[])
        case "recorded by another":
            return replace(logs, unread=[replace(logs.unread[0], collector="c")])
    raise ValueError(what)


@pytest.mark.parametrize(
    ("what", "finds"),
    [
        ("no epoch", "without having recorded an epoch"),
        ("lost", "hall: 3 was committed, and no store has it"),
        ("twice", "hall: 3 is in stores 2 times"),
        ("invented", "hall: 1000 is in a store, and no device gave it"),
        ("not sunk", "hall: 3 is in a store, not in the sink"),
        ("sunk twice", "hall: 3 is in the sink 2 times"),
        ("written twice", "the write of 77 was executed 2 times"),
        ("written although refused", "the write of 77 was executed, and reported as not"),
        ("silent", "hall was silent from 3.00 to 14.00, 11.00 s of it without a cause"),
        ("silent at the end", "hall is silent at the end"),
        ("not recorded", "hall: 5.00 s of the hole from 9.00 to 14.00 are not recorded"),
        ("recorded by another", "hall: 5.00 s of the hole from 9.00 to 14.00 are not recorded"),
    ],
)
def test_each_breach_is_found_and_named(what: str, finds: str) -> None:
    assert any(finds in each for each in judged(broken(what), BOUNDS))


def test_a_fault_a_lost_quorum_and_a_machine_that_stood_still_excuse_their_time() -> None:
    silent = broken("silent")
    assert not [each for each in judged(replace(silent, down=[(3.0, 10.0)]), BOUNDS) if "was silent" in each]
    assert not [each for each in judged(replace(silent, faults=[5.0, 9.5]), BOUNDS) if "was silent" in each]
    unrecorded = broken("not recorded")
    assert not [each for each in judged(replace(unrecorded, stalls=[(9.5, 13.0)]), BOUNDS) if "not recorded" in each]
    assert [each for each in judged(replace(unrecorded, stalls=[(9.5, 11.0)]), BOUNDS) if "3.50 s of the hole" in each]


def shorter(logs: Logs) -> Logs:
    """With a silence from 5 to 14, of nine seconds where five are allowed."""
    return replace(logs, faults=[], sunk=None, frames=[each for each in logs.frames if not 5 < each.at < 10])


@pytest.mark.parametrize(("until", "finds"), [(9.4, "9.00 s of it without a cause"), (9.6, ""), (14.0, "")])
def test_a_machine_that_stood_still_excuses_no_more_than_the_bound_again(until: float, finds: str) -> None:
    found = [each for each in judged(replace(shorter(well()), stalls=[(5.5, until)]), BOUNDS) if "was silent" in each]
    assert "".join(found).endswith(finds)
    assert bool(found) == bool(finds)
    too_long = replace(broken("silent"), stalls=[(3.0, 14.0)])
    assert [each for each in judged(too_long, BOUNDS) if "11.00 s of it without a cause" in each]


@pytest.mark.parametrize(("others", "fails"), [(1, True), (2, False)])
def test_a_run_of_which_more_than_a_third_is_excused_is_not_judged(others: int, fails: bool) -> None:
    logs = replace(shorter(well()), stalls=[(5.0, 14.0)])
    for number in range(others):  # links with a silence that needs no excuse
        logs.frames += [Frame(at, f"roof-{number}", "b", is_write=False, value=0) for at in (0, 3, *range(4, 21))]
    found = [each for each in judged(logs, BOUNDS) if "excused by a machine that stood still" in each]
    assert [each.partition(" ")[0] for each in found] == ["50%"] * fails
