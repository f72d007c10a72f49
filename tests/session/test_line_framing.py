"""Which receiver and encoder go with which framing."""

import pytest

from busway.errors import ConfigError
from busway.framing.ascii import AsciiReceiver, encode_ascii
from busway.framing.character_times import SerialTiming
from busway.framing.frame_direction import LineRole
from busway.framing.rtu import RtuReceiver, encode_rtu
from busway.framing.rtu_strict import StrictRtuReceiver
from busway.options.lines import FramingParameters
from busway.session.line_framing import line_framing

LINE = SerialTiming.of_line(9600)
NETWORK = SerialTiming.of_network()
PDU = bytes.fromhex("03 00 00 00 0a")


def test_rtu_on_a_wire_sends_after_t3_5_and_over_a_network_at_once() -> None:
    wire, network = line_framing("rtu", LineRole.MASTER, LINE), line_framing("rtu", LineRole.MASTER, NETWORK)
    assert isinstance(wire.receiver, RtuReceiver)
    assert wire.send_gap == LINE.t3_5
    assert not wire.is_network
    assert network.send_gap == 0.0
    assert network.is_network
    assert wire.encode(1, PDU) == encode_rtu(1, PDU)


@pytest.mark.clause("S12")
def test_ascii_needs_no_silence_and_follows_its_delimiter() -> None:
    framing = line_framing("ascii", LineRole.SERVER, LINE)
    assert isinstance(framing.receiver, AsciiReceiver)
    assert framing.send_gap == 0.0
    assert framing.encode(1, PDU) == encode_ascii(1, PDU)
    framing.delimit_by(ord("?"))
    assert framing.receiver.delimiter == ord("?")
    assert framing.encode(1, PDU) == encode_ascii(1, PDU, ord("?"))


def test_delimiter_of_rtu_has_no_effect() -> None:
    framing = line_framing("rtu", LineRole.SERVER, LINE)
    framing.delimit_by(ord("?"))
    assert framing.encode(1, PDU) == encode_rtu(1, PDU)


@pytest.mark.clause("S10")
def test_strict_timing_is_for_serial_ports() -> None:
    strict = FramingParameters(strict_timing=True)
    assert isinstance(line_framing("rtu", LineRole.MASTER, LINE, strict).receiver, StrictRtuReceiver)
    with pytest.raises(ConfigError, match="serial ports"):
        line_framing("rtu", LineRole.MASTER, NETWORK, strict)


@pytest.mark.parametrize(
    "options",
    [
        {"gap_limit": 0.0},
        {"gap_limit": 11.0},
        {"gap_limit": 0.1, "strict_timing": True},
        {"character_timeout": 0.0},
        {"character_timeout": 61.0},
        {"delimiter": -1},
        {"delimiter": 128},
    ],
)
def test_impossible_settings_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        FramingParameters(**options)  # type: ignore[arg-type]


def test_gap_limit_below_t3_5_is_refused_where_the_line_is_known() -> None:
    with pytest.raises(ConfigError, match=r"t3\.5"):
        line_framing("rtu", LineRole.MASTER, LINE, FramingParameters(gap_limit=0.001))
