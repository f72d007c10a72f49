"""Times of a line: bits of a character, t1.5 and t3.5 with the rule above 19 200."""

import pytest

from busway.framing.character_times import Parity, SerialTiming, character_bits, stop_bits_for


@pytest.mark.clause("S7")
@pytest.mark.parametrize("parity", list(Parity))
def test_an_rtu_character_has_eleven_bits_with_and_without_parity(parity: Parity) -> None:
    assert character_bits(8, parity) == 11


@pytest.mark.clause("S12")
@pytest.mark.parametrize("parity", list(Parity))
def test_an_ascii_character_has_ten_bits_with_and_without_parity(parity: Parity) -> None:
    assert character_bits(7, parity) == 10


@pytest.mark.clause("S7")
def test_a_second_stop_bit_takes_the_place_of_parity_unless_set_otherwise() -> None:
    assert stop_bits_for(Parity.NONE) == 2
    assert stop_bits_for(Parity.EVEN) == stop_bits_for(Parity.ODD) == 1
    assert character_bits(8, Parity.NONE, stop_bits=1) == 10


@pytest.mark.clause("S8")
def test_times_follow_the_characters_up_to_19200() -> None:
    timing = SerialTiming.of_line(9600)
    assert timing.character == pytest.approx(11 / 9600)
    assert timing.t1_5 == pytest.approx(1.5 * 11 / 9600)
    assert timing.t3_5 == pytest.approx(3.5 * 11 / 9600)
    assert SerialTiming.of_line(19_200).t3_5 == pytest.approx(3.5 * 11 / 19_200)


@pytest.mark.clause("S8")
@pytest.mark.parametrize("baud", [19_201, 38_400, 115_200])
def test_times_are_fixed_above_19200(baud: int) -> None:
    timing = SerialTiming.of_line(baud)
    assert (timing.t1_5, timing.t3_5) == (0.000750, 0.001750)


def test_a_frame_lasts_as_long_as_its_characters() -> None:
    assert SerialTiming.of_line(9600).duration(8) == pytest.approx(88 / 9600)


def test_on_a_network_characters_have_no_duration() -> None:
    timing = SerialTiming.of_network(0.01)
    assert (timing.character, timing.t3_5) == (0.0, 0.01)


@pytest.mark.parametrize("wrong", [{"data_bits": 6}, {"stop_bits": 3}, {"baud": 0}])
def test_a_setting_that_cannot_be_is_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="not"):
        SerialTiming.of_line(**wrong)


def test_times_out_of_order_are_refused() -> None:
    with pytest.raises(ValueError, match=r"t1\.5"):
        SerialTiming(0.001, 0.004, 0.002)
