"""Groups of changes: all of them or none, for every reader, and no write is lost."""

import asyncio
import struct
import sys
import threading
import time
from collections.abc import Callable
from contextvars import copy_context
from typing import TypeVar

import pytest

from busway.codes import Table
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters
from busway.pdu.write_items import MaskWriteRegister, WriteMultipleRegisters, WriteSingleRegister
from busway.server.device import Device
from busway.server.single_block import SingleBlock
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import ClientIdentity, RequestContext

T = TypeVar("T")

STRESS = 0.4
"""Seconds that threads run against each other."""


def asked(function: int) -> RequestContext:
    """The context of a request from a client."""
    return RequestContext(
        unit=1, function=function, diagnostics=CommunicationState(), client=ClientIdentity(peer="10.0.0.9:1502")
    )


def test_changes_become_visible_when_the_group_ends() -> None:
    device = Device(holding_registers=4, coils=8)
    with device.update():
        device.holding_registers[0:2] = [1, 2]
        device.coils[3] = True
        assert device.plain_block(Table.HOLDING_REGISTERS, writes=False).data == bytes(8)  # type: ignore[union-attr]
        assert ReadCoils(3, 1).apply(device, asked(1)) == ReadCoils.Reply(b"\x00")
    assert device.holding_registers[0:2] == [1, 2]
    assert ReadCoils(3, 1).apply(device, asked(1)) == ReadCoils.Reply(b"\x01")


def test_inside_the_group_its_own_changes_are_seen() -> None:
    device = Device(holding_registers={0: [1, 2], 10: 3})
    with device.update():
        device.holding_registers[0] += 10
        device.holding_registers[0] += 10
        device.holding_registers[10] = 4
        assert list(device.holding_registers) == [21, 2, 4]
    assert list(device.holding_registers) == [21, 2, 4]


def test_a_group_that_fails_changes_nothing() -> None:
    device = Device(holding_registers=[1, 2])

    def fail(error: BaseException) -> None:
        with device.update():
            device.holding_registers[0] = 5
            raise error

    for error in (ZeroDivisionError(), KeyboardInterrupt()):
        with pytest.raises(type(error)):
            fail(error)
    assert device.holding_registers[:] == [1, 2]
    device.holding_registers[0] = 9
    assert device.holding_registers[0] == 9


def test_a_group_inside_a_group_is_part_of_it() -> None:
    device = Device(holding_registers=2)
    with device.update():
        with device.update():
            device.holding_registers[0] = 1
        seen = in_another_thread(lambda: device.holding_registers[0])
    assert seen == 0
    assert device.holding_registers[0] == 1


def test_groups_of_two_devices_are_apart() -> None:
    one, other = Device(coils=1), Device(coils=1)
    with one.update():
        with other.update():
            one.coils[0] = other.coils[0] = True
        assert in_another_thread(lambda: (one.coils[0], other.coils[0])) == (False, True)
    assert one.coils[0]


def test_an_empty_group_changes_nothing() -> None:
    device = Device(coils=[True])
    with device.update():
        pass
    assert device.coils[:] == [True]


def test_a_modbus_write_during_a_group_is_not_lost_and_does_not_wait() -> None:
    device = Device(holding_registers=4)
    short = WriteMultipleRegisters.direct(device)
    assert short is not None
    with device.update():
        device.holding_registers[0:2] = [1, 2]

        def write() -> None:
            WriteSingleRegister(2, 7).apply(device, asked(6))
            short(WriteMultipleRegisters.of(3, [8]).encode(), 0, 8, ClientIdentity())
            WriteSingleRegister(1, 9).apply(device, asked(6))  # the group has written it too, and ends later

        in_another_thread(write)
        assert in_another_thread(lambda: device.holding_registers[:]) == [0, 9, 7, 8]
    assert device.holding_registers[:] == [1, 2, 7, 8]


def test_files_take_part_in_a_group_and_bits_of_a_single_block_too() -> None:
    device = Device(block=SingleBlock(2), files={1: 2})
    with device.update():
        device.files[1][0] = 5
        device.coils[0] = True
        device.holding_registers[1] = 0x8000
        assert device.coils[31] is True
        assert in_another_thread(lambda: (device.files[1][0], *device.holding_registers)) == (0, 0, 0)
    assert (device.files[1][0], *device.holding_registers) == (5, 1, 0x8000)


async def test_another_task_is_outside_the_group_of_a_task_that_waits() -> None:
    device = Device(holding_registers=2)
    inside, go_on = asyncio.Event(), asyncio.Event()

    async def group() -> None:
        with device.update():
            device.holding_registers[0] = 1
            inside.set()
            await go_on.wait()

    task = asyncio.create_task(group())
    await inside.wait()
    assert device.holding_registers[0] == 0
    device.holding_registers[1] = 2
    go_on.set()
    await task
    assert device.holding_registers[:] == [1, 2]


def test_a_thread_started_inside_a_group_writes_at_once_after_it_ended() -> None:
    device = Device(holding_registers=2)
    with device.update():
        device.holding_registers[0] = 1
        context = copy_context()
    context.run(device.holding_registers.__setitem__, 1, 2)
    assert device.holding_registers[:] == [1, 2]


def test_readers_never_see_half_of_a_group_by_the_long_or_the_fast_path() -> None:
    device = Device(holding_registers=100, coils=16)
    registers, coils = ReadHoldingRegisters.direct(device), ReadCoils.direct(device)
    assert registers is not None
    assert coils is not None
    pair, coil = ReadHoldingRegisters(40, 2), ReadCoils(9, 1)
    pair_pdu, coil_pdu = pair.encode(), coil.encode()

    def write_groups(turn: int) -> None:
        number = turn & 0xFFFF
        with device.update():
            device.coils[9] = bool(turn & 1)
            device.holding_registers[41] = number
            device.holding_registers[40] = number

    def read_short(_: int) -> None:
        high, low = struct.unpack(">HH", registers(pair_pdu, 0, 5, ClientIdentity())[2:])  # type: ignore[index]
        assert high == low

    def read_long(_: int) -> None:
        high, low = pair.apply(device, asked(3)).registers  # type: ignore[attr-defined]
        assert high == low

    def read_two_tables(_: int) -> None:
        # Unchanged before and after: then the coil between them belongs to the same group.
        before = registers(pair_pdu, 0, 5, ClientIdentity())
        state = coils(coil_pdu, 0, 5, ClientIdentity())
        after = registers(pair_pdu, 0, 5, ClientIdentity())
        assert before is not None
        assert state is not None
        if before == after:
            assert state[2] == before[-1] & 1

    compete(write_groups, read_short, read_long, read_two_tables)


def test_readers_never_see_half_of_a_group_across_the_runs_of_one_table() -> None:
    device = Device(holding_registers={0: [0, 0], 500: [0, 0]})

    def write_groups(turn: int) -> None:
        with device.update():
            for address in (0, 1, 500, 501):
                device.holding_registers[address] = turn & 0xFFFF

    def read(_: int) -> None:
        first = device.holding_registers[0:2]
        second = device.holding_registers[500:502]
        again = device.holding_registers[0:2]
        assert first[0] == first[1]
        assert second[0] == second[1]
        if first == again:
            assert first == second

    compete(write_groups, read, read)


def test_no_write_is_lost_between_groups_modbus_writes_and_mask_writes() -> None:
    device = Device(holding_registers=64)
    turns = [0, 0, 0]

    def write_groups(turn: int) -> None:
        with device.update():
            device.holding_registers[0:2] = [turn & 0xFFFF] * 2
        turns[0] = turn & 0xFFFF

    def write_by_modbus(turn: int) -> None:
        WriteSingleRegister(10, turn & 0xFFFF).apply(device, asked(6))
        assert device.holding_registers[10] == turn & 0xFFFF
        turns[1] = turn & 0xFFFF

    def count_under_the_lock(turn: int) -> None:
        with device.lock:
            device.holding_registers[20] = device.holding_registers[20] + 2 & 0xFFFF
        turns[2] = turn + 1

    def flip_lowest_bit(turn: int) -> None:
        with device.lock:
            MaskWriteRegister(20, 0xFFFE, turn & 1).apply(device, asked(22))

    compete(write_groups, write_by_modbus, count_under_the_lock, flip_lowest_bit)
    assert device.holding_registers[0:2] == [turns[0]] * 2
    assert device.holding_registers[10] == turns[1]
    assert device.holding_registers[20] & 0xFFFE == 2 * turns[2] & 0xFFFF


def in_another_thread(work: Callable[[], T]) -> T:
    """What ``work`` gives in a thread of its own."""
    results: list[T] = []
    thread = threading.Thread(target=lambda: results.append(work()))
    thread.start()
    thread.join(10)
    return results[0]


def compete(*players: Callable[[int], None]) -> None:
    """Let each player take turns in its own thread for `STRESS` seconds; fail with the first failure of any."""
    end = time.monotonic() + STRESS
    failures: list[BaseException] = []

    def play(player: Callable[[int], None]) -> None:
        turn = 0
        try:
            while not failures and (time.monotonic() < end or turn <= 10):  # on a busy machine one may begin late
                assert time.monotonic() < end + 20
                player(turn)
                turn += 1
        except BaseException as failure:
            failures.append(failure)

    threads = [threading.Thread(target=play, args=(player,)) for player in players]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)  # threads take turns after every few statements
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30)
    finally:
        sys.setswitchinterval(interval)
    if failures:
        raise failures[0]
