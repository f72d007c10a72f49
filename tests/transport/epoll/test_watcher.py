"""Many sockets on one epoll object: who is called, who is not any more, and who else has a turn."""

import asyncio
import contextlib
import os
import select
import socket
from collections.abc import Callable, Iterator

import pytest
from event_loops import LOOPS, run_on
from handles import settled_handles
from waiting import until

from busway.transport.epoll.watcher import MOST_READY, READABLE, WRITABLE, EpollSet, epoll_set_for

pytestmark = pytest.mark.skipif(not hasattr(select, "epoll"), reason="this system has no epoll objects")


class Member:
    """Writes down how often it is called, and does what it is told to then."""

    def __init__(self, then: Callable[[], None] = lambda: None) -> None:
        self.calls: list[int] = []
        self._then = then

    def ready(self, events: int) -> None:
        self.calls.append(events)
        self._then()


@contextlib.contextmanager
def readable(count: int = 1) -> Iterator[list[int]]:
    """Descriptors that have a byte to read, and keep it."""
    with contextlib.ExitStack() as opened:
        descriptors = []
        for _ in range(count):
            here, there = socket.socketpair()
            opened.enter_context(here)
            opened.enter_context(there)
            there.send(b"!")
            descriptors.append(here.fileno())
        yield descriptors


@pytest.mark.parametrize("loop", LOOPS)
def test_member_is_called_as_long_as_it_is_ready_and_until_it_is_forgotten(loop: str) -> None:
    async def main() -> None:
        epoll_set = EpollSet(asyncio.get_running_loop())
        with readable() as (descriptor,):
            member = Member()
            epoll_set.watch(descriptor, READABLE, member)
            await until(lambda: len(member.calls) == 3)
            epoll_set.watch_for(descriptor, READABLE | WRITABLE)
            await until(lambda: member.calls[-1] == READABLE | WRITABLE)
            epoll_set.forget(descriptor)
            called = len(member.calls)
            for _ in range(5):
                await asyncio.sleep(0)
            assert len(member.calls) == called

    run_on(loop, main)


@pytest.mark.parametrize("loop", LOOPS)
def test_epoll_object_exists_only_while_a_connection_is_watched(loop: str) -> None:
    async def main() -> None:
        epoll_set = EpollSet(asyncio.get_running_loop())
        with readable(2) as (first, second):
            before = settled_handles()
            for _ in range(3):
                epoll_set.watch(first, READABLE, Member())
                epoll_set.watch(second, READABLE, Member())
                assert (len(epoll_set), settled_handles()) == (2, before + 1)
                await asyncio.sleep(0)
                epoll_set.forget(first)
                epoll_set.forget(second)
                assert (len(epoll_set), settled_handles()) == (0, before)

    run_on(loop, main)


async def test_member_that_another_one_removes_in_the_same_look_is_not_called() -> None:
    epoll_set = EpollSet(asyncio.get_running_loop())
    with readable(2) as (first, second):
        members: dict[int, Member] = {}

        def remove_all() -> None:
            epoll_set.forget(first)
            epoll_set.forget(second)

        for descriptor in (first, second):
            members[descriptor] = Member(remove_all)
            epoll_set.watch(descriptor, READABLE, members[descriptor])
        await until(lambda: not len(epoll_set))
        for _ in range(3):
            await asyncio.sleep(0)
        assert sum(len(one.calls) for one in members.values()) == 1


@pytest.mark.parametrize("loop", LOOPS)
def test_with_all_ready_all_the_time_each_has_a_turn_and_so_have_the_timers(loop: str) -> None:
    size = 2 * MOST_READY + 10
    turns = 0

    async def main() -> None:
        nonlocal turns
        epoll_set = EpollSet(asyncio.get_running_loop())
        with readable(size) as descriptors:
            members = [Member() for _ in descriptors]
            for descriptor, member in zip(descriptors, members, strict=True):
                epoll_set.watch(descriptor, READABLE, member)
            timed = asyncio.Event()
            asyncio.get_running_loop().call_later(0, timed.set)
            while not (timed.is_set() and all(len(one.calls) >= 2 for one in members)):
                before = sum(len(one.calls) for one in members)
                await asyncio.sleep(0)
                turns += 1
                assert sum(len(one.calls) for one in members) - before <= 2 * MOST_READY
            calls = [len(one.calls) for one in members]
            assert max(calls) - min(calls) <= 2
            for descriptor in descriptors:
                epoll_set.forget(descriptor)

    run_on(loop, main)
    assert turns >= 4


async def test_descriptor_that_cannot_be_watched_is_refused_and_nothing_stays() -> None:
    epoll_set = EpollSet(asyncio.get_running_loop())
    before = settled_handles()
    never_ready = os.open(os.devnull, os.O_RDONLY)
    with pytest.raises(PermissionError):
        epoll_set.watch(never_ready, READABLE, Member())
    os.close(never_ready)
    assert (len(epoll_set), settled_handles()) == (0, before)


async def test_descriptor_that_was_closed_under_its_member_can_still_be_forgotten() -> None:
    epoll_set = EpollSet(asyncio.get_running_loop())
    here, there = socket.socketpair()
    with here, there:
        epoll_set.watch(here.fileno(), READABLE, Member())
        descriptor = here.fileno()
        here.close()
        epoll_set.forget(descriptor)
        assert len(epoll_set) == 0


@pytest.mark.parametrize("loop", LOOPS)
def test_loops_of_asyncio_and_uvloop_have_an_epoll_set(loop: str) -> None:
    async def main() -> None:
        assert epoll_set_for(asyncio.get_running_loop()) is not None

    run_on(loop, main)


def test_loop_that_makes_servers_its_own_way_has_none() -> None:
    class Own(asyncio.SelectorEventLoop):
        async def create_server(self, *arguments: object, **options: object) -> asyncio.Server:  # type: ignore[override]
            raise NotImplementedError

    class Usual(asyncio.SelectorEventLoop):
        pass

    with contextlib.closing(Own()) as own, contextlib.closing(Usual()) as usual:
        assert epoll_set_for(own) is None
        assert epoll_set_for(usual) is not None


async def test_system_without_epoll_objects_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(select, "epoll")
    assert epoll_set_for(asyncio.get_running_loop()) is None
