"""The server's fast path: functions that turn request bytes into reply bytes, without message objects.

Knows the wire form of the table functions and the blocks they act on; knows no session and no hooks.

1. A function of the fast path (`FastAnswer`) gets the buffer, the start and end of the PDU, and the client; it returns
   the reply PDU, or None if the request has to take the generic path. It returns None for every request that is not
   plainly valid, so all refusals are decided in one place.
2. Its reply must equal that of the generic path for every request; a property test checks that.
3. Each function is written out, also where two are alike: this saves one more call for each request.

Measured: 1.0 µs for a read of ten registers from frame to frame, against 2.1 µs by the generic path.
"""

import struct
from collections.abc import Callable
from typing import Final, Protocol

from ..codes import Table


class Requester(Protocol):
    """Interface of the client that sent a request, as functions of the fast path get it for the audit log.

    `ClientIdentity` of `busway.session.responder` implements it.

    Attributes:
        listener: URL of the listener that the client uses.
        role: role in the client's certificate; None without one.
        audit_text: text for the client in lines of the audit log; set by the audit log, empty before.
    """

    listener: str
    role: str | None
    audit_text: str

    @property
    def peer(self) -> str:
        """``host:port`` of the client, or the name of a serial line."""


FastAnswer = Callable[[bytes, int, int, Requester], bytes | None]
"""Function that answers a request from its bytes.

It gets a buffer, the start and the end of the request PDU in it, and the client. It returns the reply PDU, or None if
the request must take the generic path; then nothing was changed.
"""


class Block(Protocol):
    """Interface of the memory of consecutive registers or bits of a device, in wire order.

    The device can replace ``data`` by a new object at any time: read the attribute at each use, and do not keep the
    object.
    """

    @property
    def first(self) -> int:
        """Address of the first register or bit of the block."""

    @property
    def count(self) -> int:
        """Number of registers or bits in the block."""

    @property
    def data(self) -> bytearray:
        """The bytes of the block: registers big-endian, bits packed from the lowest bit of the first byte."""

    def put(self, position: int, count: int, data: bytes) -> bool | None:
        """Replace ``count`` items from ``position`` on by ``data``; safe from any thread.

        Args:
            position: the first item; 0 is the item at the address ``first``.
            count: number of registers or bits.
            data: the new items in wire order.

        Returns:
            None if the items were replaced. True if nothing was replaced and the request has to take the generic path,
            for example because an access rule has to check it.
        """


class ExchangingBlock(Block, Protocol):
    """Interface of a block of registers or bits whose writes can also return the values that they replace."""

    def exchange(self, position: int, count: int, data: bytes) -> bytes:
        """Replace ``count`` items from ``position`` on by ``data``, and return the old ones, in one atomic step.

        Both are in wire order. ``position`` is 0 for the item at the address ``first``.
        """


class RegisterBlock(Block, Protocol):
    """Interface of a block of registers with the two atomic operations of functions 22 and 23."""

    def mask(self, position: int, and_mask: int, or_mask: int) -> None:
        """Set the register at ``position`` to (current AND and_mask) OR (or_mask AND NOT and_mask), in one step.

        ``position`` is 0 for the register at the address ``first``. Returns nothing.
        """

    def put_then_get(self, position: int, count: int, data: bytes, start: int, size: int) -> bytes:
        """Replace ``count`` registers from ``position`` on, then read ``size`` registers from ``start`` on, atomically.

        Returns the registers read, two bytes each, big-endian. ``data`` are the registers to write. ``position`` and
        ``start`` are 0 for the register at the address ``first``.
        """


class DirectModel(Protocol):
    """Interface of a device that lets requests read and write the memory of its tables directly, for speed."""

    def plain_block(self, table: Table, *, writes: bool) -> Block | None:
        """Return a table's memory if requests may use it directly, without hooks and checks; else None.

        Args:
            table: the table.
            writes: whether the memory is wanted for writes.
        """


class PreparedAnswer:
    """The prepared answer to one particular read of registers on TCP: the bytes before the data, and which data follow.

    A client that polls repeats the same few reads. The server keeps the answer to each, under the bytes of the
    request after the transaction identifier. One look-up then checks protocol, length, unit, function, address and
    count: it takes 0.4 µs, where a function of the fast path takes 1.0.

    Args:
        head: the bytes of the reply between the transaction identifier and the data: rest of the MBAP header, function
            code, byte count.
        block: the registers of the device.
        start, stop: the first byte of ``block.data`` in the reply, and the byte after the last.

    Attributes:
        head: as the argument ``head``.
        block: the registers of the device.
        part: slice of ``block.data`` that the reply contains.
    """

    __slots__ = ("block", "head", "part")

    def __init__(self, head: bytes, block: Block, start: int, stop: int) -> None:
        self.head: bytes = head
        self.block: Block = block
        self.part: slice[int, int, None] = slice(start, stop)  # made once: two look-ups less for each answer


def prepare_answer(unit: int, pdu: bytes, limit: int, block: Block) -> PreparedAnswer | None:
    """Return the prepared answer to a read of registers on TCP.

    None if the length, the count or an address does not fit; the generic path then answers. The caller has checked that
    the function is 03 or 04 and reads ``block``.

    Args:
        unit: unit identifier of the request.
        pdu: the request PDU.
        limit: most registers in one read.
        block: the registers of the device that the function reads.
    """
    if len(pdu) != 5:
        return None
    address, count = _unpack_two(pdu, 1)
    address -= block.first
    if not (0 < count <= limit and address >= 0 and address + count <= block.count):
        return None
    head = struct.pack(">HHBBB", 0, 3 + 2 * count, unit, pdu[0], 2 * count)
    return PreparedAnswer(head, block, 2 * address, 2 * (address + count))


_unpack_two = struct.Struct(">HH").unpack_from
_number = int.from_bytes


def read_registers(code: int, limit: int, block: Block) -> FastAnswer:
    """Return a function that answers requests to read registers (03 or 04) from a block of memory.

    Args:
        code: the function code.
        limit: most registers in one read.
        block: the registers of the device.
    """
    heads: list[bytes] = [bytes((code, 2 * count)) for count in range(limit + 1)]
    first, size = block.first, block.count

    def answer(buffer: bytes, at: int, end: int, client: Requester) -> bytes | None:
        if end - at != 5:
            return None
        address, count = _unpack_two(buffer, at + 1)
        address -= first
        if 0 < count <= limit and 0 <= address <= size - count:
            reply: bytes = heads[count] + block.data[2 * address : 2 * (address + count)]
            return reply
        return None

    return answer


def read_bits(code: int, limit: int, block: Block) -> FastAnswer:
    """Return a function that answers requests to read bits (01 or 02) from a block of memory.

    Args:
        code: the function code.
        limit: most bits in one read.
        block: the coils or discrete inputs of the device.
    """
    heads: list[bytes] = [bytes((code, length)) for length in range((limit + 7) // 8 + 1)]
    first, size = block.first, block.count

    def answer(buffer: bytes, at: int, end: int, client: Requester) -> bytes | None:
        if end - at != 5:
            return None
        address, count = _unpack_two(buffer, at + 1)
        address -= first
        if not (0 < count <= limit and 0 <= address <= size - count):
            return None
        length = (count + 7) >> 3
        part = _number(block.data[address >> 3 : (address + count + 7) >> 3], "little") >> (address & 7)
        reply: bytes = heads[length] + (part & (1 << count) - 1).to_bytes(length, "little")
        return reply

    return answer


def write_register(code: int, block: Block) -> FastAnswer:
    """Return a function that executes and answers requests 06 (write single register) on a block of memory.

    Args:
        code: the function code; not used, because the reply repeats the request.
        block: the holding registers of the device.
    """
    first, size, put = block.first, block.count, block.put

    def answer(buffer: bytes, at: int, end: int, client: Requester) -> bytes | None:
        if end - at != 5:
            return None
        request = buffer[at:end]
        address = (request[1] << 8 | request[2]) - first
        if not 0 <= address < size:
            return None
        return None if put(address, 1, request[3:]) else request

    return answer


def write_registers(code: int, limit: int, block: Block) -> FastAnswer:
    """Return a function that executes and answers requests 16 (write multiple registers) on a block of memory.

    Args:
        code: the function code; not used, because the reply repeats the beginning of the request.
        limit: most registers in one write.
        block: the holding registers of the device.
    """
    first, size, put = block.first, block.count, block.put

    def answer(buffer: bytes, at: int, end: int, client: Requester) -> bytes | None:
        length = end - at - 6
        if length < 2:
            return None
        address, count = _unpack_two(buffer, at + 1)
        address -= first
        if not (length == buffer[at + 5] == 2 * count and count <= limit and 0 <= address <= size - count):
            return None
        return None if put(address, count, buffer[at + 6 : end]) else buffer[at : at + 5]

    return answer


_COIL_VALUES: Final = {b"\xff\x00": b"\x01", b"\x00\x00": b"\x00"}


def write_coil(code: int, block: Block) -> FastAnswer:
    """Return a function that executes and answers requests 05 (write single coil) on a block of memory.

    Args:
        code: the function code; not used, because the reply repeats the request.
        block: the coils of the device.
    """
    first, size, put = block.first, block.count, block.put

    def answer(buffer: bytes, at: int, end: int, client: Requester) -> bytes | None:
        if end - at != 5:
            return None
        request = buffer[at:end]
        address = (request[1] << 8 | request[2]) - first
        if not 0 <= address < size:
            return None
        value = _COIL_VALUES.get(request[3:])
        return None if value is None or put(address, 1, value) else request

    return answer


def write_coils(code: int, limit: int, block: Block) -> FastAnswer:
    """Return a function that executes and answers requests 15 (write multiple coils) on a block of memory.

    Args:
        code: the function code; not used, because the reply repeats the beginning of the request.
        limit: most coils in one write.
        block: the coils of the device.
    """
    first, size, put = block.first, block.count, block.put

    def answer(buffer: bytes, at: int, end: int, client: Requester) -> bytes | None:
        length = end - at - 6
        if length < 1:
            return None
        address, count = _unpack_two(buffer, at + 1)
        address -= first
        if not (length == buffer[at + 5] == (count + 7) >> 3 and count <= limit and 0 <= address <= size - count):
            return None
        return None if put(address, count, buffer[at + 6 : end]) else buffer[at : at + 5]

    return answer


_unpack_mask = struct.Struct(">HHH").unpack_from
_unpack_four = struct.Struct(">HHHHB").unpack_from


def mask_write_register(code: int, block: RegisterBlock) -> FastAnswer:
    """Return a function that executes and answers requests 22 (mask write register) on a block of memory.

    Args:
        code: the function code; not used, because the reply repeats the request.
        block: the holding registers of the device.
    """
    first, size, mask = block.first, block.count, block.mask

    def answer(buffer: bytes, at: int, end: int, client: Requester) -> bytes | None:
        if end - at != 7:
            return None
        address, and_mask, or_mask = _unpack_mask(buffer, at + 1)
        address -= first
        if not 0 <= address < size:
            return None
        mask(address, and_mask, or_mask)
        return buffer[at:end]

    return answer


def read_write_registers(code: int, most_read: int, most_written: int, block: RegisterBlock) -> FastAnswer:
    """Return a function that executes and answers requests 23 (write, then read registers) on a block of memory.

    Args:
        code: the function code.
        most_read, most_written: most registers in the read and in the write of one request.
        block: the holding registers of the device.
    """
    heads: list[bytes] = [bytes((code, 2 * count)) for count in range(most_read + 1)]
    first, size, put_then_get = block.first, block.count, block.put_then_get

    def answer(buffer: bytes, at: int, end: int, client: Requester) -> bytes | None:
        if end - at < 12:
            return None
        start, wanted, address, count, length = _unpack_four(buffer, at + 1)
        start -= first
        address -= first
        if not (
            end - at - 10 == length == 2 * count
            and count <= most_written
            and 0 < wanted <= most_read
            and 0 <= address <= size - count
            and 0 <= start <= size - wanted
        ):
            return None
        reply: bytes = heads[wanted] + put_then_get(address, count, buffer[at + 10 : end], start, wanted)
        return reply

    return answer
