"""Writes with a look at what they replace: exact, in one step, and only where something is executed."""

from collections.abc import Callable

import pytest

from busway.codes import Table
from busway.pdu.device_interface import Refusal
from busway.pdu.file_records import FileData, WriteFileRecord
from busway.pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleRegister,
)
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import Judged, Replaced, RequestContext


def _context(function: int, unit: int = 1, *, see: Callable[[Replaced], None]) -> RequestContext:
    context = RequestContext(unit=unit, function=function, diagnostics=CommunicationState(), finish=lambda *_: None)
    context.judged = Judged("rule", is_write=True)
    context.judged.check = see
    return context


def _device() -> Device:
    return Device(holding_registers=[10, 11, 12, 13], coils=[True, False, True], files={4: [7, 8, 9]})


@pytest.mark.parametrize(
    ("request_", "replaced"),
    [
        (WriteSingleRegister(2, 99), (b"\x00\x0c",)),
        (WriteMultipleRegisters.of(1, [1, 2]), (b"\x00\x0b\x00\x0c",)),
        (MaskWriteRegister(3, 0, 1), (b"\x00\x0d",)),
        (ReadWriteMultipleRegisters.of(0, 1, 2, [5]), (b"\x00\x0c",)),
        (WriteMultipleCoils.of(0, [False] * 3), (b"\x05",)),
        (WriteFileRecord((FileData(4, 1, b"\x00\x01"), FileData(5, 0, b"\x00\x01"))), (b"\x00\x08", None)),
        (WriteMultipleRegisters.of(3, [1, 2]), (None,)),
    ],
)
def test_what_a_write_would_replace_is_shown_before_it_is_replaced(request_, replaced):
    handler = DeviceResponder({1: _device()})
    seen = []
    try:
        handler.answer(_context(request_.code, see=seen.append), request_)
    except Refusal:
        assert None in replaced
    assert seen == [replaced]


def test_a_refusal_at_the_look_leaves_everything_as_it_was():
    device = _device()
    handler = DeviceResponder({1: device})

    def refuse(replaced):
        raise Refusal(1)

    with pytest.raises(Refusal):
        handler.answer(_context(6, see=refuse), WriteSingleRegister(0, 99))
    assert device.holding_registers[0] == 10


def test_the_look_and_the_write_hold_the_devices_lock_together():
    class Lock:
        """Counts how often it is taken, and how deep."""

        def __init__(self, inner):
            self.inner, self.outermost, self.depth = inner, 0, 0

        def __enter__(self):
            self.inner.acquire()
            self.outermost += self.depth == 0
            self.depth += 1

        def __exit__(self, *_):
            self.depth -= 1
            self.inner.release()

    device = _device()
    device.lock = lock = Lock(device.lock)
    depths = []
    DeviceResponder({1: device}).answer(
        _context(22, see=lambda replaced: depths.append(lock.depth)), MaskWriteRegister(0, 0, 5)
    )
    assert (depths, lock.outermost) == ([1], 1)
    assert device.holding_registers[0] == 5


@pytest.mark.parametrize("unit", [9])
def test_where_nothing_is_executed_nothing_is_looked_at(unit):
    seen = []
    reply = DeviceResponder({1: _device(), 2: _device()}).answer(
        _context(6, unit, see=seen.append), WriteSingleRegister(0, 1)
    )
    assert reply.exception == 0x0B
    assert seen == []


def test_a_look_calls_no_hook():
    device = _device()
    called = []
    device.on_read("holding_registers", called.append)
    assert device.peek(Table.HOLDING_REGISTERS, 0, 2) == b"\x00\x0a\x00\x0b"
    assert called == []
