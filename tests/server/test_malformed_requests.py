"""What a server answers to requests that break a rule, over real sockets: one row per rule.

The plain unit answers by compiled answers where it can, the watched one has hooks, read-only ranges and holes; rows
that need nothing of the watched one are asked of both.
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from urllib.parse import urlsplit

import pytest

import busway
from busway.server.hooks import Change
from busway.server.table_declaration import Cells
from busway.testing import golden_adu

PLAIN, WATCHED = 1, 2
FAILS, VETOES, VETOES_WITH_CODE, READ_FAILS = 900, 901, 902, 903
DISCARDED = ""

_MANY = 0x1F * "0000"


@dataclass(frozen=True, slots=True)
class Row:
    """A request PDU and the reply PDU, in hexadecimal; `DISCARDED` for none."""

    name: str
    request: str
    reply: str
    clauses: tuple[str, ...] = ("A7",)
    units: tuple[int, ...] = (PLAIN, WATCHED)

    @property
    def pdu(self) -> bytes:
        return bytes.fromhex(self.request)

    @property
    def expected(self) -> bytes:
        return bytes.fromhex(self.reply)


def _reads(code: int, limit: int, clause: str) -> list[Row]:
    """The rows that functions 01 to 04 share."""
    head, refused = f"{code:02X} ", f"{code | 0x80:02X} "
    clauses = ("A7", clause)
    return [
        Row(f"{code:02}: function code alone", head, refused + "03", clauses),
        Row(f"{code:02}: half an address", head + "00", refused + "03", clauses),
        Row(f"{code:02}: no quantity", head + "0000", refused + "03", clauses),
        Row(f"{code:02}: half a quantity", head + "0000 00", refused + "03", clauses),
        Row(f"{code:02}: one byte too many", head + "0000 0001 00", refused + "03", clauses),
        Row(f"{code:02}: as long as a PDU can be", head + "0000 0001" + 248 * "00", refused + "03", clauses),
        Row(f"{code:02}: quantity 0", head + "0000 0000", refused + "03", clauses),
        Row(f"{code:02}: quantity one beyond the limit", head + f"0000 {limit + 1:04X}", refused + "03", clauses),
        Row(f"{code:02}: largest quantity", head + "0000 FFFF", refused + "03", clauses),
        Row(f"{code:02}: first item behind the last", head + "03E8 0001", refused + "02", clauses),
        Row(f"{code:02}: last item behind the last", head + "03E7 0002", refused + "02", clauses),
        Row(f"{code:02}: range beyond 65536", head + "FFFF 0002", refused + "02", clauses),
        Row(f"{code:02}: quantity is judged before the address", head + "03E8 0000", refused + "03", clauses),
    ]


ROWS = [
    Row("function 0", "00", "80 01", ("A2", "T28")),
    Row("function 0 with data", "00 0000 0001", "80 01", ("A2", "T28")),
    Row("a reply: function 0x80", "80", DISCARDED, ("A2", "T28")),
    Row("a reply: exception of function 3", "83 02", DISCARDED, ("A2", "T28")),
    Row("a reply: function 0xFF", "FF 0000 0001", DISCARDED, ("A2", "T28")),
    Row("unknown function 9", "09", "89 01", ("A2", "A7", "T28")),
    Row("unknown function 65", "41 0000", "C1 01", ("A2", "A7", "T28")),
    Row("unknown function 127", "7F 0102", "FF 01", ("A2", "A7", "T28")),
    *_reads(0x01, 2000, "A9"),
    *_reads(0x02, 2000, "A9"),
    *_reads(0x03, 125, "A10"),
    *_reads(0x04, 125, "A10"),
    Row("05: value 0001", "05 0001 0001", "85 03", ("A7", "A11")),
    Row("05: value FF01", "05 0001 FF01", "85 03", ("A7", "A11")),
    Row("05: value 00FF", "05 0001 00FF", "85 03", ("A7", "A11")),
    Row("05: value FFFF", "05 0001 FFFF", "85 03", ("A7", "A11")),
    Row("05: no value", "05 0001", "85 03", ("A7", "A11")),
    Row("05: half a value", "05 0001 FF", "85 03", ("A7", "A11")),
    Row("05: one byte too many", "05 0001 FF00 00", "85 03", ("A7", "A11")),
    Row("05: no such coil", "05 03E8 FF00", "85 02", ("A7", "A11")),
    Row("05: the value is judged before the address", "05 03E8 0001", "85 03", ("A7", "A11")),
    Row("06: no value", "06 0001", "86 03", ("A7", "A12")),
    Row("06: half a value", "06 0001 00", "86 03", ("A7", "A12")),
    Row("06: one byte too many", "06 0001 0002 00", "86 03", ("A7", "A12")),
    Row("06: no such register", "06 03E8 0001", "86 02", ("A7", "A12")),
    Row("07: a byte too many", "07 00", "87 03", ("A7", "A22")),
    Row("08: no sub-function", "08", "88 03", ("A7", "A22")),
    Row("08: half a sub-function", "08 00", "88 03", ("A7", "A22")),
    Row("08: unknown sub-function", "08 0099 0000", "88 01", ("A7", "A22")),
    Row("08/00: no data", "08 0000", "88 03", ("A7", "A22")),
    Row("08/00: odd data", "08 0000 010203", "88 03", ("A7", "A22")),
    Row("08/02: data other than zero", "08 0002 0001", "88 03", ("A7", "A22")),
    Row("08/02: data too long", "08 0002 0000 00", "88 03", ("A7", "A22")),
    Row("08/01: restart, off on a network listener", "08 0001 0000", "88 01", ("S17",)),
    Row("08/04: listen only, off on a network listener", "08 0004 0000", "88 01", ("S17",)),
    Row("08/0A: clear counters, off on a network listener", "08 000A 0000", "88 01", ("S17",)),
    Row("11: a byte too many", "0B 00", "8B 03", ("A7", "A22")),
    Row("12: a byte too many", "0C 00", "8C 03", ("A7", "A22")),
    Row("15: quantity 0", "0F 0000 0000 00", "8F 03", ("A7", "A13")),
    Row("15: quantity 0 with data", "0F 0000 0000 01 FF", "8F 03", ("A7", "A13")),
    Row("15: quantity 1969", "0F 0000 07B1 F7" + 247 * "FF", "8F 03", ("A7", "A13")),
    Row("15: byte count too small", "0F 0000 000A 01 FF", "8F 03", ("A7", "A13")),
    Row("15: byte count too large", "0F 0000 0008 02 FFFF", "8F 03", ("A7", "A13")),
    Row("15: less data than the byte count", "0F 0000 000A 02 FF", "8F 03", ("A7", "A13")),
    Row("15: more data than the byte count", "0F 0000 000A 02 FFFFFF", "8F 03", ("A7", "A13")),
    Row("15: no byte count", "0F 0000 000A", "8F 03", ("A7", "A13")),
    Row("15: last coil behind the last", "0F 03E7 0002 01 03", "8F 02", ("A7", "A13")),
    Row("15: range beyond 65536", "0F FFFF 0002 01 03", "8F 02", ("A7", "A13")),
    Row("15: lengths are judged before the address", "0F 03E8 000A 01 FF", "8F 03", ("A7", "A13")),
    Row("16: quantity 0", "10 0000 0000 00", "90 03", ("A7", "A14")),
    Row("16: quantity 124", "10 0000 007C F8" + 246 * "00", "90 03", ("A7", "A14")),
    Row("16: byte count too small", "10 0000 0002 02 0001", "90 03", ("A7", "A14")),
    Row("16: byte count too large", "10 0000 0001 04 0001 0002", "90 03", ("A7", "A14")),
    Row("16: odd byte count", "10 0000 0001 03 000100", "90 03", ("A7", "A14")),
    Row("16: less data than the byte count", "10 0000 0002 04 0001 00", "90 03", ("A7", "A14")),
    Row("16: more data than the byte count", "10 0000 0001 02 0001 00", "90 03", ("A7", "A14")),
    Row("16: no byte count", "10 0000 0001", "90 03", ("A7", "A14")),
    Row("16: last register behind the last", "10 03E7 0002 04 0001 0002", "90 02", ("A7", "A14")),
    Row("16: range beyond 65536", "10 FFFF 0002 04 0001 0002", "90 02", ("A7", "A14")),
    Row("16: lengths are judged before the address", "10 03E8 0002 02 0001", "90 03", ("A7", "A14")),
    Row("17: a byte too many", "11 00", "91 03", ("A7", "A22")),
    Row("20: no byte count", "14", "94 03", ("A7", "A15")),
    Row("20: byte count 0", "14 00", "94 03", ("A7", "A15")),
    Row("20: byte count 6", "14 06 06 0001 0000 00", "94 03", ("A7", "A15")),
    Row("20: byte count F6", "14 F6 06 0001 0000 0001" + 239 * "00", "94 03", ("A7", "A15")),
    Row("20: byte count beyond the data", "14 0E 06 0001 0000 0001", "94 03", ("A7", "A15")),
    Row("20: second group cut off", "14 09 06 0001 0000 0001 06 00", "94 03", ("A7", "A15")),
    Row("20: reference type 5", "14 07 05 0001 0000 0001", "94 02", ("A7", "A15")),
    Row("20: file 0", "14 07 06 0000 0000 0001", "94 02", ("A7", "A15")),
    Row("20: no such file", "14 07 06 0002 0000 0001", "94 02", ("A7", "A15")),
    Row("20: record 10000", "14 07 06 0001 2710 0001", "94 02", ("A7", "A15")),
    Row("20: last record behind the last", "14 07 06 0001 0063 0002", "94 02", ("A7", "A15")),
    Row("20: no records", "14 07 06 0001 0000 0000", "94 03", ("A7", "A15")),
    Row("20: more than a reply holds", "14 07 06 0001 0000 007E", "94 03", ("A7", "A15")),
    Row("21: byte count 8", "15 08 06 0001 0000 0001 00", "95 03", ("A7", "A16")),
    Row("21: group with less data than it says", "15 09 06 0001 0000 0002 0001", "95 03", ("A7", "A16")),
    Row("21: group with more data than it says", "15 0B 06 0001 0000 0001 0001 0002", "95 03", ("A7", "A16")),
    Row("21: byte count beyond the data", "15 0B 06 0001 0000 0001 0001", "95 03", ("A7", "A16")),
    Row("21: reference type 7", "15 09 07 0001 0000 0001 FFFF", "95 02", ("A7", "A16")),
    Row(
        "21: the second group does not exist",
        "15 12 06 0001 0000 0001 FFFF 06 0002 0000 0001 FFFF",
        "95 02",
        ("A7", "A16"),
    ),
    Row("22: no masks", "16 0001", "96 03", ("A7", "A17")),
    Row("22: half an OR mask", "16 0001 0000 00", "96 03", ("A7", "A17")),
    Row("22: one byte too many", "16 0001 0000 0000 00", "96 03", ("A7", "A17")),
    Row("22: no such register", "16 03E8 0000 FFFF", "96 02", ("A7", "A17")),
    Row("23: read quantity 0", "17 0000 0000 0000 0001 02 0001", "97 03", ("A7", "A18")),
    Row("23: read quantity 126", "17 0000 007E 0000 0001 02 0001", "97 03", ("A7", "A18")),
    Row("23: write quantity 0", "17 0000 0001 0000 0000 00", "97 03", ("A7", "A18")),
    Row("23: write quantity 122", "17 0000 0001 0000 007A F4" + 243 * "00", "97 03", ("A7", "A18")),
    Row("23: byte count too small", "17 0000 0001 0000 0002 02 0001", "97 03", ("A7", "A18")),
    Row("23: byte count too large", "17 0000 0001 0000 0001 04 0001 0002", "97 03", ("A7", "A18")),
    Row("23: less data than the byte count", "17 0000 0001 0000 0002 04 0001", "97 03", ("A7", "A18")),
    Row("23: no byte count", "17 0000 0001 0000 0001", "97 03", ("A7", "A18")),
    Row("23: nothing written if the read range is not there", "17 03E8 0001 0000 0001 02 FFFF", "97 02", ("A7", "A18")),
    Row("23: the write range is not there", "17 0000 0001 03E8 0001 02 FFFF", "97 02", ("A7", "A18")),
    Row("24: half an address", "18 00", "98 03", ("A7", "A22")),
    Row("24: one byte too many", "18 000A 00", "98 03", ("A7", "A22")),
    Row("24: no queue there", "18 000B", "98 02", ("A7", "A22")),
    Row("24: more than 31 registers queued", "18 0014", "98 03", ("A7", "A22")),
    Row("43: no MEI type", "2B", "AB 03", ("A7", "A19")),
    Row("43: unknown MEI type", "2B 0F 01 00", "AB 01", ("A7", "A19")),
    Row("43/13: no CANopen here", "2B 0D 00", "AB 01", ("A7", "A22")),
    Row("43/14: no ReadDevId code", "2B 0E", "AB 03", ("A7", "A19")),
    Row("43/14: no object", "2B 0E 01", "AB 03", ("A7", "A19")),
    Row("43/14: ReadDevId code 0", "2B 0E 00 00", "AB 03", ("A7", "A19")),
    Row("43/14: ReadDevId code 5", "2B 0E 05 00", "AB 03", ("A7", "A19")),
    Row("43/14: one byte too many", "2B 0E 01 00 00", "AB 03", ("A7", "A19")),
    Row("43/14: unknown object alone", "2B 0E 04 55", "AB 02", ("A7", "A19")),
    Row("05: read-only coil", "05 03DE FF00", "85 02", ("A7",), (WATCHED,)),
    Row("06: read-only register", "06 03DE 0001", "86 02", ("A7",), (WATCHED,)),
    Row("15: last coil read-only", "0F 03DD 0002 01 03", "8F 02", ("A7",), (WATCHED,)),
    Row("16: last register read-only", "10 03DD 0002 04 FFFF FFFF", "90 02", ("A7",), (WATCHED,)),
    Row("22: read-only register", "16 03DE 0000 FFFF", "96 02", ("A7", "A17"), (WATCHED,)),
    Row("23: read-only register", "17 0000 0001 03DE 0001 02 FFFF", "97 02", ("A7", "A18"), (WATCHED,)),
    Row("21: read-only record", "15 09 06 0003 0000 0001 FFFF", "95 02", ("A7", "A16"), (WATCHED,)),
    Row("20: damaged file", "14 07 06 0004 0000 0001", "94 08", ("A15", "A20"), (WATCHED,)),
    Row("06: hook that fails", f"06 {FAILS:04X} 0001", "86 04", ("A7", "A20"), (WATCHED,)),
    Row("16: hook that fails", f"10 {FAILS - 1:04X} 0002 04 0001 0001", "90 04", ("A7", "A20"), (WATCHED,)),
    Row("06: hook with a veto", f"06 {VETOES:04X} 0001", "86 04", ("A7", "A20"), (WATCHED,)),
    Row("22: hook with a veto", f"16 {VETOES:04X} 0000 FFFF", "96 04", ("A7", "A20"), (WATCHED,)),
    Row("23: hook with a veto", f"17 0000 0001 {VETOES:04X} 0001 02 FFFF", "97 04", ("A7", "A20"), (WATCHED,)),
    Row("06: hook with a veto and a code", f"06 {VETOES_WITH_CODE:04X} 0001", "86 05", ("A20",), (WATCHED,)),
    Row("03: read hook that fails", f"03 {READ_FAILS:04X} 0001", "83 04", ("A7", "A20"), (WATCHED,)),
    Row("05: function that the device does not offer", "05 0001 FF00", "85 01", ("A2", "A7"), (3,)),
    Row("05: not offered comes before a wrong value", "05 0001 0001", "85 01", ("A2", "A7"), (3,)),
    Row("16: not offered comes before wrong lengths", "10 0000", "90 01", ("A2", "A7"), (3,)),
    Row("a unit that is not there", "03 0000 0001", "83 0B", ("T24",), (9,)),
]

CASES = [
    pytest.param(
        row,
        unit,
        id=f"unit {unit}, {row.name}",
        marks=[pytest.mark.clause(clause) for clause in row.clauses],
    )
    for row in ROWS
    for unit in row.units
]


def _declared(watched: bool) -> busway.Device:
    read_only = [(990, 10)] if watched else []
    files: dict[int, object] = {1: list(range(100))}
    if watched:
        files |= {3: Cells(count=10, read_only=[(0, 10)]), 4: 10}
    return busway.Device(
        holding_registers=Cells(values=list(range(1000)), read_only=read_only),
        input_registers=1000,
        coils=Cells(count=1000, read_only=read_only),
        discrete_inputs=1000,
        files=files,  # type: ignore[arg-type]
        fifos={10: [1, 2], 20: list(range(32))},
    )


def _watched_device() -> busway.Device:
    device = _declared(watched=True)
    device.files[4].is_consistent = False

    @device.on_write("holding_registers", address=FAILS)
    def fails(change: Change) -> None:
        raise ZeroDivisionError("the plant is on fire")

    @device.on_write("holding_registers", address=VETOES)
    def vetoes(change: Change) -> None:
        raise busway.Refusal

    @device.on_write("holding_registers", address=VETOES_WITH_CODE)
    def vetoes_with_code(change: Change) -> None:
        raise busway.Refusal(busway.ExceptionCode.ACKNOWLEDGE)

    @device.on_read("holding_registers", address=READ_FAILS)
    def read_fails(access: object) -> None:
        raise LookupError("the sensor is gone")

    return device


def _content(device: busway.Device) -> list[object]:
    """Everything that a request could change."""
    tables = (device.holding_registers, device.input_registers, device.coils, device.discrete_inputs)
    return [
        *(table.read_wire(0, len(table)) for table in (*tables, *device.files.values())),
        *(list(queue) for queue in device.fifos.values()),
    ]


@pytest.fixture(scope="module")
def devices() -> dict[int, busway.Device]:
    reader = busway.Device(holding_registers=10, coils=10, functions={1, 3})
    return {PLAIN: _declared(watched=False), WATCHED: _watched_device(), 3: reader}


@asynccontextmanager
async def _connected(
    devices: dict[int, busway.Device],
) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    async with busway.serve("tcp://127.0.0.1:0", units=devices) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", urlsplit(server.endpoints[0]).port)
        try:
            yield reader, writer
        finally:
            writer.close()
            await writer.wait_closed()


GOOD = "03 0005 0001"
GOOD_REPLY = bytes.fromhex("03 02 0005")


def _asked(row: Row, unit: int, transaction: int) -> bytes:
    return golden_adu(row.pdu, transaction=transaction, unit=unit)


def _answered(row: Row, unit: int, transaction: int) -> bytes:
    return golden_adu(row.expected, transaction=transaction, unit=unit) if row.expected else b""


def _good(transaction: int) -> bytes:
    return golden_adu(bytes.fromhex(GOOD), transaction=transaction, unit=PLAIN)


def _good_reply(transaction: int) -> bytes:
    return golden_adu(GOOD_REPLY, transaction=transaction, unit=PLAIN)


@pytest.mark.parametrize(("row", "unit"), CASES)
async def test_malformed_request_is_answered_as_documented_and_changes_nothing(
    row: Row, unit: int, devices: dict[int, busway.Device]
) -> None:
    before = [_content(device) for device in devices.values()]
    async with _connected(devices) as (reader, writer):
        writer.write(_asked(row, unit, 0x0102) + _good(7))  # the good one shows that the stream goes on
        expected = _answered(row, unit, 0x0102) + _good_reply(7)
        assert await reader.readexactly(len(expected)) == expected
    assert [_content(device) for device in devices.values()] == before


@pytest.mark.clause("T28")
@pytest.mark.parametrize("start", range(0, len(ROWS), 20))
async def test_request_that_arrives_in_two_segments_is_answered_as_in_one_wherever_it_is_cut(
    start: int, devices: dict[int, busway.Device]
) -> None:
    async with _connected(devices) as (reader, writer):
        for row in ROWS[start : start + 20]:
            unit = row.units[-1]
            adu = _asked(row, unit, 0x0304)
            # Long requests are filled with bytes that all look alike: the cuts behind the 24th tell nothing new.
            for cut in range(1, min(len(adu), 24)):
                # The answer to a good request in the same segment shows that the first part has arrived.
                writer.write(_good(1) + adu[:cut])
                assert await reader.readexactly(11) == _good_reply(1), row.name
                writer.write(adu[cut:] + _good(2))
                expected = _answered(row, unit, 0x0304) + _good_reply(2)
                assert await reader.readexactly(len(expected)) == expected, f"{row.name}, cut at {cut}"


@pytest.mark.clause("T28")
async def test_all_malformed_requests_in_one_write_are_answered_in_order(devices: dict[int, busway.Device]) -> None:
    cases = [(row, unit) for row in ROWS for unit in row.units]
    asked = b"".join(_asked(row, unit, number) for number, (row, unit) in enumerate(cases))
    expected = b"".join(_answered(row, unit, number) for number, (row, unit) in enumerate(cases))
    async with _connected(devices) as (reader, writer):
        writer.write(asked)
        assert await reader.readexactly(len(expected)) == expected


@pytest.mark.clause("A4")
async def test_range_beyond_65536_is_an_address_error_where_all_65536_exist() -> None:
    async with _connected({PLAIN: busway.Device(holding_registers=65_536, coils=65_536)}) as (reader, writer):
        for asked, reply in (
            ("03 FFFF 0001", "03 02 0000"),
            ("03 FFFF 0002", "83 02"),
            ("01 FFFF 0002", "81 02"),
            ("10 FFFF 0002 04 0001 0002", "90 02"),
            ("0F FFFF 0002 01 03", "8F 02"),
            ("17 FFFF 0002 0000 0001 02 0001", "97 02"),
        ):
            writer.write(golden_adu(bytes.fromhex(asked)))
            expected = golden_adu(bytes.fromhex(reply))
            assert await reader.readexactly(len(expected)) == expected, asked


@pytest.mark.clause("T2")
@pytest.mark.clause("T28")
@pytest.mark.parametrize("protocol", [1, 0x00FF, 0x0100, 0xFFFF])
async def test_request_with_another_protocol_is_discarded_and_the_stream_goes_on(
    protocol: int, devices: dict[int, busway.Device]
) -> None:
    foreign = bytearray(golden_adu(bytes.fromhex("06 0001 FFFF"), transaction=5, unit=PLAIN))
    foreign[2:4] = protocol.to_bytes(2, "big")
    async with _connected(devices) as (reader, writer):
        writer.write(bytes(foreign) + _good(6))
        assert await reader.readexactly(11) == _good_reply(6)
    assert devices[PLAIN].holding_registers[1] == 1


@pytest.mark.clause("T2")
@pytest.mark.clause("T28")
@pytest.mark.parametrize("length", [0, 1, 255, 256, 260, 0x7FFF, 0xFFFF])
@pytest.mark.parametrize("behind", ["", "01", "01 03", "01 03 0000 0001"])
async def test_length_that_cannot_be_ends_the_connection_after_earlier_requests_were_answered(
    length: int, behind: str, devices: dict[int, busway.Device]
) -> None:
    broken = bytes.fromhex("0009 0000") + length.to_bytes(2, "big") + bytes.fromhex(behind)
    async with _connected(devices) as (reader, writer):
        writer.write(_good(1) + _good(2) + broken)
        assert await reader.read(-1) == _good_reply(1) + _good_reply(2)


@pytest.mark.clause("T28")
async def test_header_cut_off_by_the_client_leaves_no_connection_behind(devices: dict[int, busway.Device]) -> None:
    async with busway.serve("tcp://127.0.0.1:0", units=devices) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", urlsplit(server.endpoints[0]).port)
        writer.write(_good(1)[:5])
        writer.write_eof()
        assert await reader.read(-1) == b""
        writer.close()
        await writer.wait_closed()
        assert server.status().connections == ()
