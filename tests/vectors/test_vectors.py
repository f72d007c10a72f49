"""The published frames, both directions: decoded to what their sources say, encoded again, and answered by a device."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from busway import Device
from busway.framing.ascii import AsciiReceiver, encode_ascii
from busway.framing.character_times import SerialTiming
from busway.framing.crc import crc_bytes
from busway.framing.frame_direction import LineRole
from busway.framing.lrc import lrc
from busway.framing.mbap import FrameKind, MbapReceiver, encode_mbap
from busway.framing.received import SerialFrame
from busway.framing.rtu import RtuReceiver, encode_rtu
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.file_records import FileData
from busway.pdu.functions import STANDARD
from busway.pdu.message import Message
from busway.server.device_responder import DeviceResponder
from busway.server.table_declaration import Cells
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession

VECTORS: list[dict[str, Any]] = json.loads((Path(__file__).parent / "vectors.json").read_text("utf-8"))
ASKED = [vector for vector in VECTORS if "expect" in vector and vector.get("map") == "S"]
TIMING = SerialTiming(character=0.0005, t1_5=0.00075, t3_5=0.00175)


def label(vector: dict[str, Any]) -> str:
    return f"{vector['id']} {vector['name']}"


def test_the_collection_is_whole() -> None:
    assert len(VECTORS) == 136
    assert len(ASKED) == 35


@dataclass
class Unpacked:
    """A frame without its framing, and how to put it back."""

    pdu: bytes
    around: dict[str, Any]
    again: bytes


def unpack(vector: dict[str, Any]) -> Unpacked:
    raw = bytes.fromhex(vector["hex"])
    if vector["framing"] == "pdu":
        return Unpacked(raw, {}, raw)
    if vector["framing"] == "tcp":
        frames = MbapReceiver().receive(raw)
        assert [frame.kind for frame in frames] == [FrameKind.FRAME]
        (frame,) = frames
        around = {"tid": frame.transaction, "pid": frame.protocol, "length": 1 + len(frame.pdu), "unit": frame.unit}
        return Unpacked(frame.pdu, around, encode_mbap(frame.transaction, frame.unit, frame.pdu))
    is_request = vector["direction"] == "request"
    role = LineRole.SERVER if is_request else LineRole.MASTER
    unit = vector["decoded"]["unit"]
    receiver: RtuReceiver | AsciiReceiver
    if vector["framing"] == "rtu":
        receiver = RtuReceiver(role, TIMING, units=range(256))
    else:
        receiver = AsciiReceiver(role, TIMING, units=range(256))
    if not is_request:
        receiver.expect(unit, vector["decoded"]["fc"])
    found = receiver.receive(raw, 1.0) + receiver.flush(2.0)
    assert len(found) == 1
    (serial,) = found
    assert isinstance(serial, SerialFrame)
    body = bytes((serial.unit,)) + serial.pdu
    if vector["framing"] == "rtu":
        around = {"unit": serial.unit, "crc": raw[-2:].hex(), "crc_ok": crc_bytes(body) == raw[-2:]}
        return Unpacked(serial.pdu, around, encode_rtu(serial.unit, serial.pdu))
    check = int(raw[-4:-2], 16)
    around = {"unit": serial.unit, "lrc": check, "lrc_ok": lrc(body) == check, "text": raw.decode("ascii")}
    return Unpacked(serial.pdu, around, encode_ascii(serial.unit, serial.pdu))


def decode(vector: dict[str, Any], pdu: bytes) -> Message:
    if vector["direction"] == "request":
        request = STANDARD.decode_request(pdu)
        assert isinstance(request, Message), request
        return request
    return STANDARD.decode_reply(pdu)


@pytest.mark.clause("A3")
@pytest.mark.parametrize("vector", VECTORS, ids=label)
def test_a_frame_decodes_to_what_its_source_says_and_encodes_to_its_bytes(vector: dict[str, Any]) -> None:
    frame = unpack(vector)
    message = decode(vector, frame.pdu)
    assert message.encode() == frame.pdu
    assert frame.again == bytes.fromhex(vector["hex"])
    said = {**frame.around, **facts(message, frame.pdu)}
    assert vector["decoded"].items() <= said.items(), said


def facts(message: Message, pdu: bytes) -> dict[str, Any]:
    """The fields of a message by the names that the collection has for them."""
    told: dict[str, Any] = {"fc": pdu[0] & 0x7F}
    if isinstance(message, ExceptionResponse):
        told["exception"] = message.exception
        told["exception_name"] = EXCEPTION_NAMES[message.exception]
        return told
    for name, value in message.values().items():
        for other in (NAMES.get(name, name), name):
            told[other] = value.hex() if isinstance(value, bytes) else value
    if message.sub_code is not None:
        told["mei_type" if message.code == 43 else "sub_function"] = message.sub_code
    if message.layout.length_at is not None:
        at, width = message.layout.length_offset, 2 if message.code == 24 else 1
        told["byte_count"] = told["data_length"] = int.from_bytes(pdu[at : at + width], "big")
    if message.code in (1, 2) and "data" in told:
        told["status_bytes"] = told["data"]
    if hasattr(message, "registers"):
        told["registers"] = told["values"] = message.registers
    if message.code == 24 and "count" in message.values():
        told["fifo_count"] = message.count  # type: ignore[attr-defined]
    if message.code == 20 and "groups" in message.values():
        told["subrequests"] = [
            {"ref_type": 6, "file": one.file, "record": one.record, "length": one.count}
            for one in message.groups  # type: ignore[attr-defined]
        ]
    if message.code in (20, 21):
        told["data"] = pdu[2:].hex()
        for one in getattr(message, "groups", ()):
            assert not isinstance(one, FileData) or one.encode().hex() in told["data"]
    if message.code == 43 and "objects" in told:
        told["objects"] = b"".join(one.encode() for one in message.objects).hex()  # type: ignore[attr-defined]
    return told


NAMES = {
    "count": "quantity",
    "read_count": "read_quantity",
    "write_count": "write_quantity",
    "level": "read_code",
}
EXCEPTION_NAMES = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target failed to respond",
}


def example_device() -> Device:
    """Map S: the values of the specification's examples."""
    coils = [0] * 1185
    for position in range(19):  # 19…37: CD 6B 05
        coils[19 + position] = 0x056BCD >> position & 1
    inputs = {196 + position: 0x35DBAC >> position & 1 for position in range(22)}
    return Device(
        coils=coils,
        discrete_inputs=inputs,
        holding_registers=Cells(
            values={
                0: [0, 0, 0, 0x00FE, 0x0ACD, 0x0001, 0x0003, 0x000D, 0x00FF, *[0] * 12],
                107: [0x022B, 0x0000, 0x0064],
            },
            read_only=[(107, 3)],
        ),
        input_registers={8: 0x000A},
        exception_status=0x6D,
        fifos={1246: [0x01B8, 0x1284]},
        files={4: {1: [0x0DFE, 0x0020], 7: [0, 0, 0]}, 3: {9: [0x33CD, 0x0040]}},
    )


class Asked:
    """A fresh device behind a session."""

    def __init__(self) -> None:
        self.late: list[bytes] = []
        self.diagnostics = LineDiagnostics(changes_allowed=True)
        self.session = TcpServerSession(
            RequestPipeline(DeviceResponder({1: example_device()})),
            diagnostics=self.diagnostics,
            slots=ServerTransactionSlots(1),
            deliver=self.late.append,
        )

    def ask(self, pdu: bytes) -> bytes | None:
        adu = encode_mbap(0x1501, 255, pdu)
        answers = self.session.receive(adu, len(adu))
        assert not self.late
        assert not self.session.failures
        if not answers:
            return None
        (frame,) = MbapReceiver().receive(b"".join(answers))
        assert (frame.transaction, frame.protocol, frame.unit) == (0x1501, 0, 255)
        return frame.pdu


@pytest.mark.clause("A21")
@pytest.mark.parametrize("vector", ASKED, ids=label)
def test_a_fresh_device_answers_a_request_as_its_source_says(vector: dict[str, Any]) -> None:
    pdu, expected = unpack(vector).pdu, vector["expect"]
    reply = Asked().ask(pdu)
    if expected["kind"] == "silence":
        assert reply is None
        return
    assert reply is not None
    if pdu[0] in (11, 12):  # the numbers depend on what happened before
        assert type(STANDARD.decode_reply(reply)) is type(STANDARD.decode_reply(bytes.fromhex(expected["hex"])))
    elif expected["kind"] == "response":
        assert reply == bytes.fromhex(expected["hex"])
    elif expected["kind"] == "prefix":
        assert reply.startswith(bytes.fromhex(expected["hex"]))
        assert len(reply) == expected["length"]
    else:
        identification = STANDARD.decode_reply(reply)
        assert reply[:3] == b"\x2b\x0e\x01"
        assert identification.conformity in (1, 2, 3, 0x81, 0x82, 0x83)  # type: ignore[attr-defined]
        assert (reply[4], reply[5]) == (0, 0)
        numbers = [one.number for one in identification.objects]  # type: ignore[attr-defined]
        assert numbers == ([0, 1, 2] if pdu[3] == 0 else [2])


@pytest.mark.clause("S17")
def test_what_is_silent_stays_so_until_a_restart_that_is_silent_too() -> None:
    asked = Asked()
    assert asked.ask(bytes.fromhex("03 006B 0003")) == bytes.fromhex("03 06 022B 0000 0064")
    assert asked.ask(bytes.fromhex("08 0004 0000")) is None
    for pdu in ("03 006B 0003", "08 0000 A537", "41", "07", "06 0001 0003", "08 000A 0000"):
        assert asked.ask(bytes.fromhex(pdu)) is None
    assert asked.ask(bytes.fromhex("08 0001 0000")) is None
    assert asked.ask(bytes.fromhex("06 0001 0003")) == bytes.fromhex("06 0001 0003")
    assert asked.ask(bytes.fromhex("03 0001 0001")) == bytes.fromhex("03 02 0003")
