"""Whose turn it is: priority hosts, those who ask little, those who ask without end."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

import pytest

import busway.server.turns
from busway.server.turns import TURN_SECONDS, Turns

SHARE = TURN_SECONDS / 4 + 1e-6
"""Seconds that a share of work takes in these tests."""


@dataclass
class Loop:
    """An event loop whose turns and whose clock the test has in hand."""

    soon: list[Callable[[], None]] = field(default_factory=list)
    now: float = 100.0

    def call_soon(self, callback: Callable[[], None], *arguments: Any) -> None:
        self.soon.append(callback)

    def turn(self) -> None:
        """What is due."""
        due, self.soon = self.soon, []
        for callback in due:
            callback()


@dataclass(eq=False)
class Client:
    """One with so many shares of work, each of which takes its time."""

    name: str
    loop: Loop
    worked: list[str]
    shares: int = 1
    is_priority: bool = False
    is_greedy: bool = False

    def take_turn(self) -> bool:
        self.loop.now += SHARE
        self.worked.append(self.name)
        self.shares -= 1
        return self.shares > 0


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> Loop:
    made = Loop()
    monkeypatch.setattr(busway.server.turns, "seconds", lambda: made.now)
    return made


@pytest.fixture
def turns(loop: Loop) -> Turns:
    return Turns(cast(asyncio.AbstractEventLoop, loop))


def test_priority_hosts_work_first_in_every_turn_and_the_others_as_far_as_its_time_goes(
    loop: Loop, turns: Turns
) -> None:
    worked: list[str] = []
    for name in ("a", "b", "c"):
        turns.wait(Client(name, loop, worked, shares=9, is_greedy=True))
    turns.wait(Client("little", loop, worked))
    turns.wait(Client("priority", loop, worked, shares=2, is_priority=True))
    loop.turn()
    assert worked == ["priority", "little", "a"]  # half a turn is theirs who waited, and each kind has a share at least
    loop.turn()
    assert worked[3:] == ["priority", "b"]
    loop.turn()
    assert worked[5:] == ["c", "a"]


def test_those_who_ask_little_do_not_keep_those_who_ask_much_from_one_share_a_turn(loop: Loop, turns: Turns) -> None:
    worked: list[str] = []
    turns.wait(Client("much", loop, worked, shares=9, is_greedy=True))
    for name in range(8):
        turns.wait(Client(str(name), loop, worked))
    loop.turn()
    loop.turn()
    assert worked == ["0", "1", "much", "2", "3", "much"]


def test_who_has_more_than_a_share_waits_behind_all_of_its_kind(loop: Loop, turns: Turns) -> None:
    worked: list[str] = []
    for name in ("a", "b", "c"):
        turns.wait(Client(name, loop, worked, shares=2, is_greedy=True))
    while turns.is_crowded:
        loop.turn()
    assert worked == ["a", "b", "c", "a", "b", "c"]


def test_it_is_crowded_while_a_connection_waits_and_nothing_is_called_after_that(loop: Loop, turns: Turns) -> None:
    assert not turns.is_crowded
    turns.wait(Client("a", loop, [], shares=2, is_greedy=True))
    assert turns.is_crowded
    loop.turn()
    assert turns.is_crowded
    loop.turn()
    assert not turns.is_crowded
    assert loop.soon == []


def test_work_beyond_the_time_of_a_turn_makes_it_crowded_until_the_next(loop: Loop, turns: Turns) -> None:
    turns.worked()
    assert not turns.is_crowded
    loop.now += TURN_SECONDS / 2
    turns.worked()
    assert turns.has_time
    assert not turns.is_crowded
    loop.now += TURN_SECONDS
    turns.worked()
    assert not turns.has_time
    assert turns.is_crowded
    loop.turn()
    assert not turns.is_crowded
