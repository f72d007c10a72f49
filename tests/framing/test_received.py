"""What receivers have in common: all of them can be driven in the same way."""

import pytest

from busway.framing.ascii import AsciiReceiver, encode_ascii
from busway.framing.character_times import SerialTiming
from busway.framing.frame_direction import LineRole
from busway.framing.mbap import MbapReceiver, encode_mbap
from busway.framing.received import Found, Receiver, SerialFrame, SerialReceiver
from busway.framing.rtu import RtuReceiver, encode_rtu
from busway.framing.rtu_strict import StrictRtuReceiver

LINE = SerialTiming.of_line(19_200)
PDU = bytes.fromhex("03 00 00 00 0A")


def drive(receiver: Receiver[Found], data: bytes) -> list[Found]:
    """What a driver does: feed, then wake the receiver at its deadlines."""
    found = receiver.receive(data, 1.0)
    while (due := receiver.deadline()) is not None:
        found += receiver.tick(due)
    return found


@pytest.mark.parametrize(
    ("receiver", "frame"),
    [
        (RtuReceiver(LineRole.SERVER, LINE, units={1}), encode_rtu(1, PDU)),
        (StrictRtuReceiver(LineRole.SERVER, LINE, units={1}), encode_rtu(1, PDU)),
        (AsciiReceiver(LineRole.SERVER, LINE, units={1}), encode_ascii(1, PDU)),
    ],
)
def test_serial_receivers_stand_behind_one_protocol(receiver: SerialReceiver, frame: bytes) -> None:
    [found] = drive(receiver, frame)
    assert isinstance(found, SerialFrame)
    assert (found.unit, found.pdu) == (1, PDU)


def test_the_mbap_receiver_is_driven_in_the_same_way() -> None:
    [found] = drive(MbapReceiver(), encode_mbap(9, 1, PDU))
    assert (found.transaction, found.unit, found.pdu) == (9, 1, PDU)
