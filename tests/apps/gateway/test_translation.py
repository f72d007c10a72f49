"""What a request looks like behind a route, and its answer in listener."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

import busway
from busway.apps.gateway.routes import Route
from busway.apps.gateway.translation import Translated
from busway.codes import Table
from busway.errors import InvalidRequest
from busway.pdu.unknown_functions import OpaqueRequest

SHIFTED = Route(upstream="a", shift=100)


class _Device:
    """Executes requests on a real device, without a connection."""

    def __init__(self) -> None:
        self.device = busway.Device(
            holding_registers=[n * 7 & 0xFFFF for n in range(2100)],
            input_registers=[n * 3 & 0xFFFF for n in range(2100)],
            coils=[n % 3 == 0 for n in range(4000)],
            discrete_inputs=[n % 5 == 0 for n in range(4000)],
        )

    def ask(self, request: busway.Request) -> busway.Message:
        context = busway.RequestContext(unit=1, function=request.code, diagnostics=None)  # type: ignore[arg-type]
        return request.apply(self.device, context)


REQUESTS = st.one_of(
    st.builds(busway.ReadHoldingRegisters, st.integers(0, 1700), st.integers(1, 125)),
    st.builds(busway.ReadInputRegisters, st.integers(0, 1700), st.integers(1, 125)),
    st.builds(busway.ReadCoils, st.integers(0, 1700), st.integers(1, 2000)),
    st.builds(busway.ReadDiscreteInputs, st.integers(0, 1700), st.integers(1, 2000)),
    st.builds(busway.WriteSingleRegister, st.integers(0, 1700), st.integers(0, 0xFFFF)),
    st.builds(
        busway.WriteMultipleRegisters.of,
        st.integers(0, 1700),
        st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=123),
    ),
    st.builds(busway.WriteMultipleCoils.of, st.integers(0, 1700), st.lists(st.booleans(), min_size=1, max_size=1968)),
    st.builds(busway.MaskWriteRegister, st.integers(0, 1700), st.integers(0, 0xFFFF), st.integers(0, 0xFFFF)),
)


@given(REQUESTS, st.integers(1, 125), st.integers(1, 2000))
def test_a_request_in_pieces_has_the_answer_and_effect_of_the_whole(
    request: busway.Request, registers: int, bits: int
) -> None:
    route = Route(upstream="a", max_registers=registers, max_bits=bits, split_writes=True)
    whole, split = _Device(), _Device()
    asked = Translated(request, route)
    reply = asked.whole([split.ask(one) for one in asked.requests])
    assert asked.client_reply(reply) == whole.ask(request)
    for table in Table:
        view = table.value
        assert getattr(whole.device, view)[0:2000] == getattr(split.device, view)[0:2000]


@given(REQUESTS, st.integers(-200, 200))
def test_a_shift_moves_the_addresses_and_the_answer_moves_them_back(request: busway.Request, shift: int) -> None:
    route = Route(upstream="a", shift=shift)
    address = request.spans()[0].address
    if address + shift < 0:
        with pytest.raises(InvalidRequest):
            Translated(request, route)
        return
    asked = Translated(request, route)
    (moved,) = asked.requests
    assert moved.spans()[0].address == address + shift
    reply = asked.client_reply(_Device().ask(moved))
    if request.spans()[0].writes:
        assert request.prepare()[:5] == reply.encode()[:5]


def test_both_addresses_of_function_23_are_shifted() -> None:
    (moved,) = Translated(busway.ReadWriteMultipleRegisters.of(1, 2, 3, [4]), SHIFTED).requests
    assert isinstance(moved, busway.ReadWriteMultipleRegisters)
    assert (moved.read_address, moved.write_address) == (101, 103)


def test_a_shift_beyond_the_table_is_refused() -> None:
    with pytest.raises(InvalidRequest):
        Translated(busway.ReadHoldingRegisters(65_500, 10), SHIFTED)


def test_writes_are_not_split_unless_asked_for() -> None:
    request = busway.WriteMultipleRegisters.of(0, [1, 2, 3])
    assert Translated(request, Route(upstream="a", max_registers=1)).requests == (request,)


def test_a_function_without_addresses_goes_through_as_it_is() -> None:
    for request in (OpaqueRequest(0x41, b"abc"), busway.ReportServerId()):
        assert Translated(request, SHIFTED).requests == (request,)
