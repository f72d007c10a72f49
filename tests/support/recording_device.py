"""A device and a context that write down what is asked of them: for tests of what functions do, and in which order."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from busway.codes import ExceptionCode, Table
from busway.pdu.bits import slice_bits, splice_bits
from busway.pdu.device_interface import Refusal
from busway.session.diagnostic_counters import CommunicationState


@dataclass
class FakeContext:
    """Who asks."""

    peer: str = "192.0.2.7:40000"
    unit: int = 1
    diagnostics: CommunicationState = field(default_factory=lambda: CommunicationState(changes_allowed=True))


class RecordingModel:
    """Tables of ``size`` items each; ``calls`` lists every call in order, and ``refuse`` makes one of them fail.

    Args:
        size: items of each table, from address 0 on.
        read_only: addresses of holding registers and coils that may not be written.
    """

    def __init__(self, size: int = 200, read_only: tuple[int, ...] = ()) -> None:
        self.size = size
        self.read_only = read_only
        self.calls: list[tuple[object, ...]] = []
        self.refuse: dict[str, Refusal] = {}
        self.registers = bytearray(2 * size)
        self.bits = bytearray((size + 7) // 8)
        self.files: dict[tuple[int, int], bytes] = {}
        self.queues: dict[int, bytes] = {}
        self.objects: dict[int, bytes] = {0: b"vendor", 1: b"code", 2: b"1.0"}
        self.status = 0x6D
        self.id = b"\x2a\xff"

    def _note(self, *call: object) -> None:
        self.calls.append(call)
        refusal = self.refuse.get(str(call[0]))
        if refusal is not None:
            raise refusal

    def check(self, table: Table, address: int, count: int, writes: bool, context: object = None) -> None:
        self._note("check", table, address, count, writes)
        if address + count > self.size:
            raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS)
        if writes and any(address <= one < address + count for one in self.read_only):
            raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS)

    def read(self, table: Table, address: int, count: int, context: object) -> bytes:
        self._note("read", table, address, count)
        if table.holds_bits:
            return slice_bits(self.bits, address, count)
        return bytes(self.registers[2 * address : 2 * (address + count)])

    def write(self, table: Table, address: int, count: int, data: bytes, context: object) -> None:
        self._note("write", table, address, count, data)
        if table.holds_bits:
            splice_bits(self.bits, address, count, data)
        else:
            self.registers[2 * address : 2 * (address + count)] = data

    def read_file(self, file: int, record: int, count: int, context: object) -> bytes:
        self._note("read_file", file, record, count)
        records = [self.files.get((file, one)) for one in range(record, record + count)]
        if None in records:
            raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS)
        return b"".join(one for one in records if one is not None)

    def write_file(self, file: int, record: int, data: bytes, context: object, *, dry: bool = False) -> None:
        self._note("write_file", file, record, data, dry)
        if any((file, one) not in self.files for one in range(record, record + len(data) // 2)):
            raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS)
        if not dry:
            for position in range(len(data) // 2):
                self.files[file, record + position] = data[2 * position : 2 * position + 2]

    def read_fifo(self, address: int, context: object) -> bytes:
        self._note("read_fifo", address)
        if address not in self.queues:
            raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS)
        return self.queues[address]

    def exception_status(self) -> int:
        self._note("exception_status")
        return self.status

    def server_id(self) -> bytes:
        self._note("server_id")
        return self.id

    def identification(self) -> Mapping[int, bytes]:
        self._note("identification")
        return self.objects

    def canopen(self, data: bytes) -> bytes:
        self._note("canopen", data)
        return data[::-1]
