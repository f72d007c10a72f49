"""Files and queues."""

from typing import Any

import pytest

from busway.codes import ExceptionCode
from busway.errors import ConfigError, InvalidRequest
from busway.pdu.device_interface import Refusal
from busway.pdu.file_records import FileData, FileReference, ReadFileRecord, WriteFileRecord
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadFifoQueue
from busway.server.device import Device
from busway.server.table_declaration import Cells
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import RequestContext


def execute(device: Device, request: Request) -> Message:
    """Execute a request as a server does."""
    with device.lock:
        return request.apply(device, RequestContext(unit=1, function=request.code, diagnostics=CommunicationState()))


def refusal_of(device: Device, request: Request) -> int:
    """The exception code that a request is refused with."""
    with pytest.raises(Refusal) as caught:
        execute(device, request)
    return caught.value.code


def plant() -> Device:
    """The files of the example of §6.14."""
    return Device(files={4: {1: 0x0DFE, 2: 0x0020}, 3: Cells(first=9, values=[0x33CD, 0x0040], read_only=[(10, 1)])})


def test_the_example_of_the_specification_is_read() -> None:
    request = ReadFileRecord.of([FileReference(4, 1, 2), FileReference(3, 9, 2)])
    assert execute(plant(), request).encode() == bytes.fromhex("14 0C 05 06 0D FE 00 20 05 06 33 CD 00 40")


def test_records_are_written_and_seen_by_the_application() -> None:
    device = plant()
    request = WriteFileRecord.of(4, 1, [7, 8])
    assert execute(device, request).encode() == request.encode()
    assert device.files[4][1:3] == [7, 8]
    device.files[3][10] = 5
    assert execute(device, ReadFileRecord.of([FileReference(3, 10, 1)])).contents[0].registers == [5]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("reference", "code"),
    [
        (FileReference(5, 1, 1), ExceptionCode.ILLEGAL_DATA_ADDRESS),
        (FileReference(4, 0, 1), ExceptionCode.ILLEGAL_DATA_ADDRESS),
        (FileReference(4, 2, 2), ExceptionCode.ILLEGAL_DATA_ADDRESS),
        (FileReference(4, 9999, 2), ExceptionCode.ILLEGAL_DATA_ADDRESS),
        (FileReference(4, 1, 0), ExceptionCode.ILLEGAL_DATA_VALUE),
    ],
)
def test_records_that_do_not_exist_are_refused(reference: FileReference, code: int) -> None:
    assert refusal_of(plant(), ReadFileRecord((FileReference(4, 1, 1), reference))) == code


def test_one_group_that_cannot_be_written_leaves_all_groups_as_they_were() -> None:
    device = plant()
    for bad in (FileData(3, 10, b"\0\1"), FileData(3, 11, b"\0\1"), FileData(9, 0, b"\0\1")):
        request = WriteFileRecord((FileData(4, 1, b"\0\1"), bad))
        assert refusal_of(device, request) == ExceptionCode.ILLEGAL_DATA_ADDRESS
    assert device.files[4][1] == 0x0DFE


def test_a_damaged_file_is_answered_with_08_and_the_others_work() -> None:
    device = plant()
    device.files[3].is_consistent = False
    assert refusal_of(device, ReadFileRecord.of([FileReference(3, 9, 1)])) == ExceptionCode.MEMORY_PARITY_ERROR
    damaged = WriteFileRecord((FileData(4, 1, b"\0\1"), FileData(3, 9, b"\0\1")))
    assert refusal_of(device, damaged) == ExceptionCode.MEMORY_PARITY_ERROR
    assert execute(device, ReadFileRecord.of([FileReference(4, 1, 1)])).contents[0].registers == [0x0DFE]  # type: ignore[attr-defined]
    assert device.files[3][9] == 0x33CD
    device.files[3].is_consistent = True
    execute(device, ReadFileRecord.of([FileReference(3, 9, 1)]))


def test_the_last_record_of_the_largest_file_is_9999() -> None:
    device = Device(files={0xFFFF: 10_000})
    device.files[0xFFFF][9999] = 1
    assert execute(device, ReadFileRecord.of([FileReference(0xFFFF, 9999, 1)])).contents[0].registers == [1]  # type: ignore[attr-defined]


@pytest.mark.parametrize("files", [{0: 1}, {65536: 1}, {"4": 1}, {4: 10_001}, {4: {10_000: 1}}, {4: [65536]}])
def test_files_that_cannot_be_are_refused(files: Any) -> None:
    with pytest.raises(ConfigError, match="files"):
        Device(files=files)


def test_a_queue_is_read_oldest_first_and_stays() -> None:
    device = Device(fifos={1246: [0x01B8, 0x1284]})
    for _ in range(2):
        reply = execute(device, ReadFifoQueue(1246))
        assert reply.encode() == bytes.fromhex("18 00 06 00 02 01 B8 12 84")


def test_the_application_pushes_pops_and_clears() -> None:
    device = Device(fifos={0: []})
    queue = device.fifos[0]
    queue.push(1, 2, 3)
    assert queue.pop() == 1
    assert list(queue) == [2, 3]
    assert len(queue) == 2
    queue.clear()
    assert execute(device, ReadFifoQueue(0)).encode() == bytes.fromhex("18 00 02 00 00")
    with pytest.raises(IndexError):
        queue.pop()


def test_more_than_31_registers_are_answered_with_03_until_some_are_taken() -> None:
    device = Device(fifos={7: range(32)})
    assert refusal_of(device, ReadFifoQueue(7)) == ExceptionCode.ILLEGAL_DATA_VALUE
    device.fifos[7].pop()
    assert execute(device, ReadFifoQueue(7)).registers == list(range(1, 32))  # type: ignore[attr-defined]


def test_there_is_no_queue_where_none_was_declared() -> None:
    assert refusal_of(Device(fifos={7: []}), ReadFifoQueue(8)) == ExceptionCode.ILLEGAL_DATA_ADDRESS


def test_a_value_that_is_no_register_is_not_queued() -> None:
    queue = Device(fifos={7: []}).fifos[7]
    with pytest.raises(InvalidRequest):
        queue.push(1, 65536)
    assert list(queue) == []


@pytest.mark.parametrize("fifos", [{-1: []}, {65536: []}, {"7": []}, {7: [65536]}, {7: ["1"]}, {7: 5}])
def test_queues_that_cannot_be_are_refused(fifos: Any) -> None:
    with pytest.raises(ConfigError, match="fifos"):
        Device(fifos=fifos)
