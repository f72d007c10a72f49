"""Clauses A1, A5, A6, A10, A21, A24 and T36 from end to end: what a device is made of, as a client sees it."""

import pytest
from scripted_peer import ScriptedPeer, echo_of

import busway
from busway.codes import PDU_LIMIT, TCP_ADU_LIMIT
from busway.framing.mbap import FrameKind, MbapFrame, MbapReceiver, encode_mbap
from busway.pdu.functions import AnyRequest
from busway.server.single_block import SingleBlock
from busway.session.responder import ResponderAnswer, ServedUnit

ANY_PORT = "tcp://127.0.0.1:0"


@pytest.mark.clause("A1")
def test_the_longest_pdu_makes_a_frame_of_260_bytes_and_a_longer_one_is_a_broken_stream() -> None:
    longest = encode_mbap(1, 1, bytes(PDU_LIMIT))
    assert len(longest) == TCP_ADU_LIMIT == 260
    assert [frame.kind for frame in MbapReceiver().receive(longest)] == [FrameKind.FRAME]
    longer = encode_mbap(1, 1, bytes(PDU_LIMIT + 1))
    assert [frame.kind for frame in MbapReceiver().receive(longer)] == [FrameKind.BROKEN]


@pytest.mark.clause("A1", "A10")
async def test_125_registers_are_read_in_one_request_and_126_are_refused_on_both_sides() -> None:
    device = busway.Device(holding_registers=list(range(200)), input_registers=200)
    async with (
        busway.serve(ANY_PORT, units={1: device}) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        unit = link.unit(1)
        assert await unit.read_holding_registers(75, count=125) == list(range(75, 200))
        assert await unit.read_input_registers(0, count=125) == [0] * 125
        with pytest.raises(busway.InvalidRequest):
            await unit.read_holding_registers(0, count=126)
        for function in (3, 4):
            with pytest.raises(busway.ExceptionReply) as caught:
                await unit.execute(busway.OpaqueRequest(function, b"\x00\x00\x00\x7e"))
            assert caught.value.code == busway.ExceptionCode.ILLEGAL_DATA_VALUE


@pytest.mark.clause("A5")
async def test_the_four_tables_of_a_device_share_no_memory() -> None:
    device = busway.Device(holding_registers=4, input_registers=4, coils=64, discrete_inputs=64)
    async with (
        busway.serve(ANY_PORT, units={1: device}) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        await link.unit(1).write_multiple_registers(0, [0xFFFF] * 4)
        assert await link.unit(1).read_coils(0, count=64) == [False] * 64
        assert await link.unit(1).read_input_registers(0, count=4) == [0] * 4
        assert await link.unit(1).read_discrete_inputs(0, count=64) == [False] * 64


@pytest.mark.clause("A6")
async def test_one_block_is_reached_by_bits_and_by_words() -> None:
    device = busway.Device(block=SingleBlock(registers=4))
    async with (
        busway.serve(ANY_PORT, units={1: device}) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        unit = link.unit(1)
        await unit.write_single_register(1, 0x8001)
        assert await unit.read_coils(16, count=16) == [True, *[False] * 14, True]
        await unit.write_single_coil(17, True)
        assert await unit.read_holding_registers(1, count=1) == [0x8003]
        assert await unit.read_input_registers(1, count=1) == [0x8003]


@pytest.mark.clause("A21")
async def test_a_request_ends_as_a_reply_as_nothing_or_as_an_exception() -> None:
    def refused(frame: MbapFrame) -> bytes:
        return encode_mbap(frame.transaction, frame.unit, b"\x83\x02")

    answers = {0: lambda frame: echo_of(frame, 7), 1: lambda frame: None, 2: refused}

    async with (
        ScriptedPeer(lambda peer, frame: answers[frame.pdu[2]](frame)) as peer,
        busway.open(peer.endpoint, retries=0, timeout=10) as link,
    ):
        assert await link.unit(1).read_holding_registers(0, count=1) == [7]
        with pytest.raises(busway.NoReply):
            await link.unit(1).read_holding_registers(1, count=1, timeout=0.05)
        with pytest.raises(busway.ExceptionReply):
            await link.unit(1).read_holding_registers(2, count=1)


@pytest.mark.clause("A24")
@pytest.mark.parametrize(
    ("request_pdu", "reply_pdu"),
    [
        ("02 00 C4 00 16", "02 03 AC DB 35"),  # the reply's code is 02, not 82
        ("01 04 A0 00 01", "01 01 00"),  # 04A0 is output 1185, the last one there is …
        ("01 04 A1 00 01", "81 02"),  # … so 04A1 is not there
        ("03 00 04 00 01", "03 02 00 05"),  # register 5 is address 4
        ("14 0E 06 00 04 00 01 00 02 06 00 03 00 09 00 02", "14 0C 05 06 0D FE 00 20 05 06 33 CD 00 40"),
        ("15 09 06 00 04 00 07 00 01 06 AF", "15 09 06 00 04 00 07 00 01 06 AF"),  # 21 is 15, not 14
        ("16 00 06 00 F2 00 25", "16 00 06 00 F2 00 25"),  # 22, with 12 in the register
        ("03 00 06 00 01", "03 02 00 17"),  # 12 AND F2 OR (25 AND NOT F2)
        ("10 00 00 00 7B F6" + " 00" * 246, "10 00 00 00 7B"),  # 123 registers: a PDU of 252 bytes; 253 is the limit
        ("2B 0E 09 00", "AB 03"),  # not AB 0E 03
    ],
)
async def test_the_server_answers_what_holds_and_not_what_is_misprinted(request_pdu: str, reply_pdu: str) -> None:
    device = busway.Device(
        coils=1185,
        discrete_inputs={196: [bool(0xACDB35 >> (16 - 8 * (bit // 8) + bit % 8) & 1) for bit in range(22)]},
        holding_registers=[1, 2, 3, 4, 5, 6, 0x17 if request_pdu.startswith("03 00 06") else 0x12, *[0] * 120],
        files={4: {1: [0x0DFE, 0x0020], 7: [0, 0, 0]}, 3: {9: [0x33CD, 0x0040]}},
    )
    function = int(request_pdu[:2], 16)
    pdu = bytes.fromhex(request_pdu)
    async with (
        busway.serve(ANY_PORT, units={1: device}) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        try:
            reply = await link.unit(1).execute(busway.OpaqueRequest(function, pdu[1:]))
            got = reply.encode()
        except busway.ExceptionReply as refusal:
            got = refusal.raw
        assert got == bytes.fromhex(reply_pdu)
        if function == 0x16:
            assert device.holding_registers[6] == 0x17


class Elsewhere:
    """User data that is no device of ours: each register holds its address, plus what was written."""

    def __init__(self) -> None:
        self.written: dict[int, bytes] = {}

    def check(self, table: busway.Table, address: int, count: int, writes: bool) -> None:
        if address + count > 100:
            raise busway.Refusal(busway.ExceptionCode.ILLEGAL_DATA_ADDRESS)

    def read(self, table: busway.Table, address: int, count: int, context: object) -> bytes:
        items = range(address, address + count)
        return b"".join(self.written.get(item, item.to_bytes(2, "big")) for item in items)

    def write(self, table: busway.Table, address: int, count: int, data: bytes, context: object) -> None:
        for position in range(count):
            self.written[address + position] = data[2 * position : 2 * position + 2]


class OwnHandler:
    """Executes requests on `Elsewhere`."""

    functions = busway.STANDARD
    generation = 0

    def __init__(self) -> None:
        self.data = Elsewhere()

    def serves(self, unit: int) -> ServedUnit | None:
        return ServedUnit(unit)

    def answer(self, context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
        assert isinstance(request, busway.Request)
        return request.apply(self.data, context)  # type: ignore[arg-type]


@pytest.mark.clause("T36")
async def test_user_data_is_read_and_written_through_one_interface_wherever_it_lives() -> None:
    handler = OwnHandler()
    async with busway.serve(ANY_PORT, responder=handler) as server, busway.open(server.endpoints[0]) as link:
        unit = link.unit(1)
        assert await unit.read_holding_registers(40, count=2) == [40, 41]
        await unit.write_multiple_registers(40, [7, 8])
        await unit.mask_write_register(40, and_mask=0xFFF0, or_mask=0x0001)
        assert await unit.read_holding_registers(39, count=3) == [39, 1, 8]
        with pytest.raises(busway.ExceptionReply) as caught:
            await unit.read_holding_registers(99, count=2)
    assert caught.value.code == busway.ExceptionCode.ILLEGAL_DATA_ADDRESS
    assert handler.data.written == {40: b"\x00\x01", 41: b"\x00\x08"}
