"""What reads cost: the figures of the Serial Line specification, and what follows from them for gaps."""

import pytest

from busway.apps.collector.cost import ReadCost, baud_cost, line_cost, network_cost
from busway.codes import Table
from busway.framing.character_times import Parity, SerialTiming

REGISTERS = Table.HOLDING_REGISTERS


def test_a_read_on_a_slow_line_costs_thirteen_characters_two_silences_the_response_time_and_its_registers() -> None:
    cost = baud_cost(9600, response_time=0.010)
    character = 11 / 9600
    assert cost.base == pytest.approx(13 * character + 2 * 3.5 * character + 0.010)
    assert cost.base == pytest.approx(0.0329, abs=0.0001)
    assert cost.of(REGISTERS, 10) == pytest.approx(cost.base + 20 * character)
    assert int(cost.base / cost.per_register) == 14  # gaps up to here are cheaper to read than to leave out


def test_above_19200_baud_the_silences_stand_still_and_wider_holes_are_worth_reading() -> None:
    cost = baud_cost(115_200, response_time=0.005)
    assert cost.base == pytest.approx(0.0097, abs=0.0001)
    assert cost.per_register == pytest.approx(0.00019, abs=0.000002)
    assert int(cost.base / cost.per_register) == 51


def test_eight_bits_cost_one_character() -> None:
    cost = baud_cost(9600)
    assert cost.of(Table.COILS, 80) - cost.of(Table.COILS, 72) == pytest.approx(11 / 9600)


def test_ascii_takes_twice_the_characters_of_ten_bits_and_no_silences() -> None:
    timing = SerialTiming.of_line(9600, data_bits=7, parity=Parity.EVEN)
    cost = line_cost(timing, "ascii", response_time=0.010)
    assert cost.base == pytest.approx(28 * 10 / 9600 + 0.010)
    assert cost.per_register == pytest.approx(4 * 10 / 9600)


def test_a_pause_between_requests_that_is_longer_than_the_silence_belongs_to_the_base() -> None:
    timing = SerialTiming.of_line(9600)
    assert line_cost(timing, gap=0.040).base == pytest.approx(line_cost(timing).base - timing.t3_5 + 0.040)
    assert line_cost(timing, gap=0.001) == line_cost(timing)


def test_over_a_network_only_the_number_of_reads_counts() -> None:
    cost = network_cost(0.005)
    assert cost.of(REGISTERS, 125) < 1.01 * cost.of(REGISTERS, 1)
    assert cost.of(REGISTERS, 125) > cost.of(REGISTERS, 1)


def test_costs_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="above 0"):
        ReadCost(0.0, 0.001, 0.0001)
