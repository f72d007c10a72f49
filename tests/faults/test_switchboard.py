"""Faults by name: put on, switched, watched, and put on from sections and words."""

import threading
from typing import Any

import pytest

from busway import ConfigError
from busway.apps.simulator.added_faults import fault_profile_lines, put_on, put_on_by_words
from busway.config.files.fault_sections import FaultSection
from busway.faults.switchboard import FaultSwitchboard
from busway.testing import FAULT_PROFILES, Schedule


def test_fault_has_a_name_a_switch_and_a_count() -> None:
    switchboard = FaultSwitchboard()
    assert switchboard.add("late", parameters={"delay": 2}) == "late"
    assert switchboard.add("late", units={3}, on=False) == "late-2"
    assert switchboard.add("busy", name="monday", schedule=Schedule(times=1)) == "monday"
    assert [(one.name, one.fault_profile, one.is_on, one.struck) for one in switchboard] == [
        ("late", "late", True, 0),
        ("late-2", "late", False, 0),
        ("monday", "busy", True, 0),
    ]
    assert switchboard.status("late").parameters == {"delay": 2}
    assert switchboard.status("late-2").parameters == {"delay": 1.5}
    assert switchboard.status("monday").happens == FAULT_PROFILES["busy"].happens
    assert switchboard.status("late-2").selection.units == {3}


def test_fault_is_switched_and_removed_by_its_name() -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("late")
    switchboard.switch("late", on=False)
    assert not switchboard.status("late").is_on
    switchboard.switch("late", on=True)
    assert switchboard.status("late").is_on
    switchboard.remove("late")
    assert switchboard.list() == []


@pytest.mark.parametrize("ask", ["switch", "remove", "status"])
def test_unknown_name_lists_those_there_are(ask: str) -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("late")
    switchboard.add("busy")
    with pytest.raises(ConfigError, match="there is no fault 'lat'; there are: late, busy"):
        getattr(switchboard, ask)("lat", **({"on": True} if ask == "switch" else {}))


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"fault_profile": "lazy"}, "lazy"),
        ({"fault_profile": "late", "name": "x"}, "name"),
        ({"fault_profile": "late", "parameters": {"delay": -1}}, "delay"),
        ({"fault_profile": "late", "parameters": {"pause": 1}}, "pause"),
        ({"fault_profile": "late", "probability": 2.0}, "probability"),
    ],
)
def test_invalid_fault_is_refused_with_its_key_and_nothing_changes(options: dict[str, Any], key: str) -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("late", name="x")
    with pytest.raises(ConfigError) as caught:
        switchboard.add(**options)
    assert caught.value.key == key
    assert [one.name for one in switchboard] == ["x"]


def test_a_watcher_is_called_for_every_change_until_it_is_removed() -> None:
    switchboard = FaultSwitchboard()
    seen: list[list[tuple[str, bool]]] = []
    stop = switchboard.watch(lambda: seen.append([(one.name, one.is_on) for one in switchboard]))
    switchboard.add("late")
    switchboard.switch("late", on=True)  # it is on already: nothing changes
    switchboard.switch("late", on=False)
    switchboard.remove("late")
    stop()
    switchboard.add("busy")
    assert seen == [[("late", True)], [("late", False)], []]


def test_board_is_changed_from_many_threads_at_once() -> None:
    switchboard = FaultSwitchboard()

    def work(number: int) -> None:
        for turn in range(20):
            name = switchboard.add("late", name=f"{number}/{turn}")
            switchboard.switch(name, on=False)
            if turn % 2:
                switchboard.remove(name)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(8)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert len(switchboard.list()) == 80
    assert not switchboard.faults.is_any_on


def test_sections_get_their_names_first_and_others_what_is_left() -> None:
    switchboard = FaultSwitchboard()
    sections = [
        FaultSection(fault_profile="late"),
        FaultSection(fault_profile="busy", name="late", on=False),
        FaultSection(fault_profile="late", addresses=["4x1-4x10"], parameters={"delay": 1}),
    ]
    assert put_on(switchboard, sections) == ["late-2", "late", "late-3"]
    assert [one.fault_profile for one in switchboard] == ["late", "busy", "late"]
    assert not switchboard.status("late").is_on
    assert switchboard.status("late-3").parameters == {"delay": 1}


def test_words_switch_a_fault_of_that_name_on_or_put_a_fault_profile_on() -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("busy", name="slow meters", on=False)
    assert put_on_by_words(switchboard, "slow meters") == "slow meters"
    assert switchboard.status("slow meters").is_on
    assert put_on_by_words(switchboard, "late:delay=0.5,name=x") == "x"
    assert switchboard.status("x").parameters == {"delay": 0.5}
    assert put_on_by_words(switchboard, "wedged") == "wedged"
    with pytest.raises(ConfigError, match="there is no fault profile 'lazy'"):
        put_on_by_words(switchboard, "lazy")


def test_list_shows_every_fault_profile_with_its_parameters() -> None:
    text = "\n".join(fault_profile_lines())
    for name, fault_profile in FAULT_PROFILES.items():
        assert f"\n{name} " in f"\n{text}"
        assert fault_profile.happens in text
        for option in fault_profile.options:
            assert f" {option}" in text
    assert "delay=1.5: seconds from request to reply (0…86400)" in text
