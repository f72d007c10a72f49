"""Hooks: who learns of which access, who may refuse it, and what it leaves behind."""

from dataclasses import FrozenInstanceError
from typing import Any

import pytest

from busway.codes import ExceptionCode, Table
from busway.errors import ConfigError
from busway.pdu.device_interface import Refusal
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters, ReadInputRegisters
from busway.pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)
from busway.server.device import Device
from busway.server.hooks import Access, Change
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import ClientIdentity, RequestContext


def execute(device: Device, request: Request) -> Message:
    """Execute a request as a server does."""
    context = RequestContext(
        unit=17,
        function=request.code,
        diagnostics=CommunicationState(),
        client=ClientIdentity(peer="10.0.0.9:1502", role="operator"),
    )
    with device.lock:
        return request.apply(device, context)


def test_a_write_hook_learns_who_writes_what_over_what() -> None:
    device = Device(holding_registers=[1, 2, 3])
    changes: list[Change] = []
    device.on_write("holding_registers", changes.append)
    execute(device, WriteMultipleRegisters.of(1, [8, 9]))
    assert changes == [
        Change("10.0.0.9:1502", 17, Table.HOLDING_REGISTERS, 1, 2, [2, 3], [8, 9], function=16, role="operator")
    ]


def test_bits_reach_a_hook_as_states() -> None:
    device = Device(coils=[True, False, True])
    changes: list[Change] = []
    device.on_write("coils", changes.append)
    execute(device, WriteMultipleCoils.of(0, [False, True, True]))
    execute(device, WriteSingleCoil(2, 0))
    assert [(change.old, change.new) for change in changes] == [
        ([True, False, True], [False, True, True]),
        ([True], [False]),
    ]
    assert changes[0].new[0] is False


def test_before_comes_before_the_change_and_after_after_it() -> None:
    device = Device(holding_registers=[5])
    seen: list[tuple[str, int]] = []

    @device.on_write("holding_registers", when="after")
    def written(change: Change) -> None:
        seen.append(("after", device.holding_registers[0]))

    @device.on_write("holding_registers", when="before")
    def asked(change: Change) -> None:
        seen.append(("before", device.holding_registers[0]))

    execute(device, WriteSingleRegister(0, 6))
    assert seen == [("before", 5), ("after", 6)]


@pytest.mark.parametrize(
    ("raised", "code"),
    [
        (Refusal(), ExceptionCode.SERVER_DEVICE_FAILURE),
        (Refusal(ExceptionCode.ILLEGAL_DATA_VALUE), ExceptionCode.ILLEGAL_DATA_VALUE),
    ],
)
def test_a_veto_changes_nothing_and_ends_the_hooks(raised: Refusal, code: int) -> None:
    device = Device(holding_registers=[5, 6])
    later: list[Change] = []

    @device.on_write("holding_registers")
    def refuse(change: Change) -> None:
        raise raised

    device.on_write("holding_registers", later.append)
    device.on_write("holding_registers", later.append, when="after")
    with pytest.raises(Refusal) as caught:
        execute(device, WriteMultipleRegisters.of(0, [1, 2]))
    assert caught.value.code == code
    assert device.holding_registers[:] == [5, 6]
    assert later == []


def test_a_hook_that_fails_before_the_write_changes_nothing() -> None:
    device = Device(coils=1)

    @device.on_write("coils")
    def fail(change: Change) -> None:
        raise RuntimeError("valve unknown")

    with pytest.raises(RuntimeError, match="valve unknown"):
        execute(device, WriteSingleCoil(0, 0xFF00))
    assert device.coils[0] is False


def test_what_a_hook_raises_after_the_write_leaves_the_change() -> None:
    device = Device(coils=1)

    @device.on_write("coils", when="after")
    def fail(change: Change) -> None:
        raise RuntimeError("too late")

    with pytest.raises(RuntimeError, match="too late"):
        execute(device, WriteSingleCoil(0, 0xFF00))
    assert device.coils[0] is True


def test_a_read_hook_sets_what_will_be_read() -> None:
    device = Device(input_registers=4)

    @device.on_read("input_registers", address=2)
    def measure(access: Access) -> None:
        assert access.values == []
        device.input_registers[2] = 321

    after: list[Access] = []
    device.on_read(Table.INPUT_REGISTERS, after.append, when="after")
    assert execute(device, ReadInputRegisters(1, 3)).registers == [0, 321, 0]  # type: ignore[attr-defined]
    assert after == [Access("10.0.0.9:1502", 17, Table.INPUT_REGISTERS, 1, 3, [0, 321, 0], function=4, role="operator")]


def test_a_read_hook_may_refuse() -> None:
    device = Device(coils=4)

    @device.on_read("coils")
    def refuse(access: Access) -> None:
        raise Refusal(ExceptionCode.SERVER_DEVICE_BUSY)

    with pytest.raises(Refusal) as caught:
        execute(device, ReadCoils(0, 1))
    assert caught.value.code == ExceptionCode.SERVER_DEVICE_BUSY


@pytest.mark.parametrize(
    ("address", "count", "called"),
    [(9, 1, False), (10, 1, True), (8, 3, True), (12, 1, True), (13, 1, False), (8, 10, True), (0, 10, False)],
)
def test_a_hook_of_a_range_is_called_for_what_touches_it(address: int, count: int, called: bool) -> None:
    device = Device(holding_registers=100)
    reads: list[Access] = []
    writes: list[Change] = []
    device.on_read("holding_registers", reads.append, address=10, count=3)
    device.on_write("holding_registers", writes.append, address=10, count=3)
    execute(device, ReadHoldingRegisters(address, count))
    execute(device, WriteMultipleRegisters.of(address, [1] * count))
    assert (bool(reads), bool(writes)) == (called, called)


def test_an_access_that_cannot_be_calls_no_hook() -> None:
    device = Device(holding_registers=10)
    called: list[object] = []
    device.on_read("holding_registers", called.append)
    device.on_write("holding_registers", called.append)
    for request in (ReadHoldingRegisters(9, 2), WriteSingleRegister(10, 1), MaskWriteRegister(10, 0, 0)):
        with pytest.raises(Refusal):
            execute(device, request)
    assert called == []


def test_the_application_calls_no_hook() -> None:
    device = Device(holding_registers=10)
    called: list[object] = []
    device.on_read("holding_registers", called.append)
    device.on_write("holding_registers", called.append)
    device.holding_registers[0] = device.holding_registers[1]
    device.write("4x1", device.read("4x1"))
    assert called == []


def test_a_mask_write_reads_and_then_writes_under_its_own_code() -> None:
    device = Device(holding_registers=[0x12])
    called: list[Any] = []
    device.on_read("holding_registers", called.append, when="after")
    device.on_write("holding_registers", called.append)
    execute(device, MaskWriteRegister(0, 0xF2, 0x25))
    access, change = called
    assert (access.values, access.function) == ([0x12], 22)
    assert (change.old, change.new, change.function) == ([0x12], [0x17], 22)


def test_a_read_write_writes_and_then_reads_under_its_own_code() -> None:
    device = Device(holding_registers=[1, 2])
    called: list[Any] = []
    device.on_read("holding_registers", called.append, when="after")
    device.on_write("holding_registers", called.append)
    execute(device, ReadWriteMultipleRegisters.of(0, 2, 1, [9]))
    change, access = called
    assert (change.old, change.new, change.function) == ([2], [9], 23)
    assert (access.values, access.function) == ([1, 9], 23)


def test_a_removed_hook_is_called_no_more() -> None:
    device = Device(holding_registers=1, coils=1)
    called: list[Any] = []
    device.on_read("coils", called.append)
    device.on_write("holding_registers", called.append)
    device.remove_hook(called.append)
    execute(device, ReadCoils(0, 1))
    execute(device, WriteSingleRegister(0, 1))
    assert called == []
    with pytest.raises(ConfigError, match="is no hook"):
        device.remove_hook(called.append)


def test_a_decorator_gives_the_function_back() -> None:
    def function(change: object) -> None: ...

    device = Device()
    assert device.on_write("coils")(function) is function
    assert device.on_write("coils", function) is function
    assert device.on_read("coils")(function) is function


def test_what_a_hook_learns_cannot_be_changed() -> None:
    device = Device(holding_registers=1)

    @device.on_write("holding_registers")
    def cheat(change: Change) -> None:
        change.new = [7]  # type: ignore[misc]

    with pytest.raises(FrozenInstanceError):
        execute(device, WriteSingleRegister(0, 1))


@pytest.mark.parametrize(
    ("table", "options", "sentence"),
    [
        ("registers", {}, "there is no table 'registers'"),
        ("coils", {"when": "during"}, "before or after, not 'during'"),
        ("coils", {"count": 3}, "needs their first address"),
        ("coils", {"address": -1}, "not within"),
        ("coils", {"address": 65535, "count": 2}, "not within"),
        ("coils", {"address": 0, "count": 0}, "not within"),
    ],
)
def test_a_hook_that_cannot_be_is_refused_before_it_sees_a_function(
    table: str, options: dict[str, Any], sentence: str
) -> None:
    device = Device(coils=1)
    with pytest.raises(ConfigError, match=sentence):
        device.on_read(table, **options)
    with pytest.raises(ConfigError, match=sentence):
        device.on_write(table, **options)


def test_nothing_is_written_to_tables_that_are_only_read() -> None:
    with pytest.raises(ConfigError, match="no function writes input registers"):
        Device().on_write("input_registers")
