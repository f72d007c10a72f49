"""Interfaces of a device through which a request reads and writes it (`Request.apply`).

Knows only method signatures; knows no device, store, session or transport.

1. Data are passed in wire order: registers big-endian, bits packed from the lowest bit.
2. A device refuses with `Refusal`. A refused request has changed nothing, unless a hook refuses it that is called after
   the write.
3. ``check`` comes before every change, so a request that concerns two ranges changes both or none.
"""

from collections.abc import Mapping
from typing import Protocol

from ..codes import ExceptionCode, Table, exception_meaning


class Refusal(Exception):
    """Raised by a device, a hook or a handler to refuse a request with an exception code.

    Args:
        code: exception code, 1…255; 04 (server device failure) if none is given.
        reason: why, for the log and the audit log; it is not sent to the client. Empty for none.

    Raises:
        ValueError: ``code`` is not 1…255.

    Attributes:
        code: the exception code.
        reason: why the request is refused; empty if that was not given.
    """

    def __init__(self, code: int = ExceptionCode.SERVER_DEVICE_FAILURE, reason: str = "") -> None:
        if not 1 <= code <= 255:
            raise ValueError(f"an exception code is 1…255, not {code}")
        super().__init__(reason or exception_meaning(code))
        self.code: int = int(code)
        self.reason = reason


class Diagnostics(Protocol):
    """Interface of a unit's diagnostics: counters and event log (functions 08, 11, 12)."""

    def diagnose(self, sub_code: int, data: bytes) -> bytes:
        """Execute a sub-function of 08 with the ``data`` of the request, and return the data of the reply.

        Raises:
            Refusal: 01: the unit does not offer the sub-function.
        """

    def event_counter(self) -> tuple[int, int]:
        """Return status word (0, or 0xFFFF while a program command runs) and number of successful messages.

        The number can be above 65535; the reply has its lowest 16 bits.
        """

    def event_log(self) -> tuple[int, int, int, bytes]:
        """Return status word, number of successful messages, number of all messages, and event bytes.

        The first two are those of `event_counter`. There are at most 64 event bytes, the newest first.
        """


class Context(Protocol):
    """Interface through which a device learns about a request, besides its data: client, unit and diagnostics."""

    @property
    def peer(self) -> str:
        """Address of the client, ``host:port`` or the name of a serial line."""

    @property
    def unit(self) -> int:
        """The unit identifier that the request was sent to, 0…255."""

    @property
    def diagnostics(self) -> Diagnostics:
        """Diagnostic counters and event log of the unit that the request was sent to."""


class Tables(Protocol):
    """Interface of the four tables of a device, as requests use them (Application Protocol V1.1b3 §4.3)."""

    def check(self, table: Table, address: int, count: int, writes: bool, context: Context | None = None) -> None:
        """Raise `Refusal` 02 unless all items of a range exist, and may be written if ``writes``.

        Args:
            table: the table.
            address: the first item, 0-based.
            count: number of items.
            writes: whether the items are to be written.
            context: client and unit. If given, and ``writes`` is False, the hooks called before a read are called too,
                and any of them can raise `Refusal`: function 23 checks its read in this way before it writes.
        """

    def read(self, table: Table, address: int, count: int, context: Context) -> bytes:
        """Return ``count`` items of a table from ``address`` on, in wire order.

        Raises:
            Refusal: an item does not exist (02), or a hook refuses the read.
        """

    def write(self, table: Table, address: int, count: int, data: bytes, context: Context) -> None:
        """Replace ``count`` items of a table from ``address`` on, all or none.

        Args:
            table: the table.
            address: the first item, 0-based.
            count: number of items.
            data: the new items in wire order.
            context: the client and the unit, for hooks.

        Raises:
            Refusal: the device or a hook refuses the write; nothing was changed, unless a hook called after the write
                has raised it.
        """


class Records(Protocol):
    """Interface of file records and queues of a device (Application Protocol V1.1b3 §6.14, §6.15, §6.18)."""

    def read_file(self, file: int, record: int, count: int, context: Context) -> bytes:
        """Return ``count`` registers of a file (1…65535) from ``record`` (0…9999) on, in wire order.

        Raises:
            Refusal: the file does not exist, or does not have all of these registers.
        """

    def write_file(self, file: int, record: int, data: bytes, context: Context, *, dry: bool = False) -> None:
        """Replace registers of a file from ``record`` on by ``data``.

        Args:
            file: number of the file, 1…65535.
            record: number of the first record, 0…9999.
            data: the registers, in wire order.
            context: the client and the unit.
            dry: whether only to check that the device accepts the write; nothing is replaced then.

        Raises:
            Refusal: the device does not accept the write.
        """

    def read_fifo(self, address: int, context: Context) -> bytes:
        """Return all registers of the queue at ``address``, oldest first, in wire order, without removing them.

        Raises:
            Refusal: there is no queue at this address.
        """


class Identity(Protocol):
    """Interface through which requests read the status and identification of a device (07, 17, 43/13, 43/14)."""

    def exception_status(self) -> int:
        """Return the eight status bits that function 07 reads, as a number 0…255."""

    def server_id(self) -> bytes:
        """Return the data that function 17 reads: server id, run indicator (00 or FF), additional data."""

    def identification(self) -> Mapping[int, bytes]:
        """Return the identification objects of function 43/14 by number, 0x00…0xFF."""

    def canopen(self, data: bytes) -> bytes:
        """Return the answer to the data of a CANopen general reference (43/13).

        Raises:
            Refusal: 01: the device does not answer such requests.
        """


class DataModel(Tables, Records, Identity, Protocol):
    """Interface of a whole device, through which requests read and write it: tables, files, queues, identification."""
