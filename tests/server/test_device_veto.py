"""Function 23 asks the hooks that may veto its read before it writes (A7: a request that fails changes nothing)."""

import pytest

from busway.pdu.device_interface import Refusal
from busway.pdu.functions import STANDARD
from busway.pdu.write_items import ReadWriteMultipleRegisters
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.server.hooks import Access
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import RequestContext


@pytest.mark.clause("A7", "A18")
def test_a_refused_read_of_function_23_leaves_its_write_undone() -> None:
    device = Device(holding_registers=10)

    @device.on_read("holding_registers", address=5, count=1)
    def refuse(access: Access) -> None:
        raise Refusal(4)

    handler = DeviceResponder({1: device})
    context = RequestContext(unit=1, function=23, diagnostics=CommunicationState())
    request = STANDARD.decode_request(ReadWriteMultipleRegisters.of(5, 1, 0, [77]).encode())

    with pytest.raises(Refusal):
        handler.answer(context, request)

    assert device.holding_registers[0] == 0
