"""Faults by name: put on, switched, watched, and put on from sections and words."""

import threading

import pytest

from busway import ConfigError
from busway.apps.simulator.added_faults import fault_profile_lines, put_on, put_on_by_words
from busway.config.files.fault_sections import FaultSection
from busway.faults.switchboard import FaultSwitchboard
from busway.testing import FAULT_PROFILES, Schedule


def test_fault_has_a_name_a_switch_and_a_count() -> None:
    board = FaultSwitchboard()
    assert board.add("late", parameters={"delay": 2}) == "late"
    assert board.add("late", units={3}, on=False) == "late-2"
    assert board.add("busy", name="monday", schedule=Schedule(times=1)) == "monday"
    assert [(one.name, one.fault_profile, one.is_on, one.struck) for one in board] == [
        ("late", "late", True, 0),
        ("late-2", "late", False, 0),
        ("monday", "busy", True, 0),
    ]
    assert board.status("late").parameters == {"delay": 2}
    assert board.status("late-2").parameters == {"delay": 1.5}
    assert board.status("monday").happens == FAULT_PROFILES["busy"].happens
    assert board.status("late-2").selection.units == {3}


def test_fault_is_switched_and_removed_by_its_name() -> None:
    board = FaultSwitchboard()
    board.add("late")
    board.switch("late", on=False)
    assert not board.status("late").is_on
    board.switch("late", on=True)
    assert board.status("late").is_on
    board.remove("late")
    assert board.list() == []


@pytest.mark.parametrize("ask", ["switch", "remove", "status"])
def test_unknown_name_lists_those_there_are(ask: str) -> None:
    board = FaultSwitchboard()
    board.add("late")
    board.add("busy")
    with pytest.raises(ConfigError, match="there is no fault 'lat'; there are: late, busy"):
        getattr(board, ask)("lat", **({"on": True} if ask == "switch" else {}))


def test_what_cannot_be_put_on_is_refused_with_its_key_and_nothing_changes() -> None:
    board = FaultSwitchboard()
    board.add("late", name="x")
    for options, key in (
        ({"fault_profile": "lazy"}, "lazy"),
        ({"fault_profile": "late", "name": "x"}, "name"),
        ({"fault_profile": "late", "parameters": {"delay": -1}}, "delay"),
        ({"fault_profile": "late", "parameters": {"pause": 1}}, "pause"),
        ({"fault_profile": "late", "probability": 2.0}, "probability"),
    ):
        with pytest.raises(ConfigError) as caught:
            board.add(**options)  # type: ignore[arg-type]
        assert caught.value.key == key
    assert [one.name for one in board] == ["x"]


def test_whoever_watches_is_told_of_every_change_until_he_has_enough() -> None:
    board = FaultSwitchboard()
    seen: list[list[tuple[str, bool]]] = []
    stop = board.watch(lambda: seen.append([(one.name, one.is_on) for one in board]))
    board.add("late")
    board.switch("late", on=True)  # it is on already: nothing changes
    board.switch("late", on=False)
    board.remove("late")
    stop()
    board.add("busy")
    assert seen == [[("late", True)], [("late", False)], []]


def test_board_is_changed_from_many_threads_at_once() -> None:
    board = FaultSwitchboard()

    def work(number: int) -> None:
        for turn in range(20):
            name = board.add("late", name=f"{number}/{turn}")
            board.switch(name, on=False)
            if turn % 2:
                board.remove(name)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(8)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert len(board.list()) == 80
    assert not board.faults.is_any_on


def test_sections_get_their_names_first_and_others_what_is_left() -> None:
    board = FaultSwitchboard()
    sections = [
        FaultSection(fault_profile="late"),
        FaultSection(fault_profile="busy", name="late", on=False),
        FaultSection(fault_profile="late", addresses=["4x1-4x10"], parameters={"delay": 1}),
    ]
    assert put_on(board, sections) == ["late-2", "late", "late-3"]
    assert [one.fault_profile for one in board] == ["late", "busy", "late"]
    assert not board.status("late").is_on
    assert board.status("late-3").parameters == {"delay": 1}


def test_words_switch_a_fault_of_that_name_on_or_put_a_fault_profile_on() -> None:
    board = FaultSwitchboard()
    board.add("busy", name="slow meters", on=False)
    assert put_on_by_words(board, "slow meters") == "slow meters"
    assert board.status("slow meters").is_on
    assert put_on_by_words(board, "late:delay=0.5,name=x") == "x"
    assert board.status("x").parameters == {"delay": 0.5}
    assert put_on_by_words(board, "wedged") == "wedged"
    with pytest.raises(ConfigError, match="there is no fault profile 'lazy'"):
        put_on_by_words(board, "lazy")


def test_list_shows_every_fault_profile_with_its_parameters() -> None:
    text = "\n".join(fault_profile_lines())
    for name, fault_profile in FAULT_PROFILES.items():
        assert f"\n{name} " in f"\n{text}"
        assert fault_profile.happens in text
        for option in fault_profile.options:
            assert f" {option}" in text
    assert "delay=1.5: seconds from request to reply (0…86400)" in text
