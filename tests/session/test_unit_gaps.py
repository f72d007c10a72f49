"""Units of a line that are left alone after their replies, while others are asked."""

import pytest
from virtual_bus import Bus

from busway.options.client import ClientParameters
from busway.pdu.read_items import ReadHoldingRegisters
from busway.server.device import Device

CHARACTER = 11 / 9600
T3_5 = 3.5 * CHARACTER
READ = ReadHoldingRegisters(0, 2)
GAP = 0.2


def devices(*units: int) -> dict[int, Device]:
    return {unit: Device(holding_registers=4) for unit in units}


def test_a_unit_is_not_asked_before_its_gap_is_over_counted_from_the_end_of_its_reply() -> None:
    bus = Bus()
    master = bus.master()
    bus.servers(devices(1))
    master.session.set_unit_gaps({1: GAP})
    for _ in range(3):
        master.get(1, READ)
    talks = bus.line.transmissions()
    assert [talks[2].begin - talks[1].end, talks[4].begin - talks[3].end] == pytest.approx([GAP, GAP])


def test_other_units_are_asked_meanwhile() -> None:
    bus = Bus()
    master = bus.master()
    bus.servers(devices(1, 2))
    master.session.set_unit_gaps({1: GAP})
    questions = [master.ask(unit, READ, caller=caller) for caller, unit in enumerate((1, 1, 2, 2, 2))]
    bus.run(until=lambda: all(question.done for question in questions))
    talks = bus.line.transmissions()
    assert [talk.data[0] for talk in talks[::2]] == [1, 2, 2, 2, 1]
    assert [talks[at].begin - talks[at - 1].end for at in (2, 4, 6)] == pytest.approx([T3_5] * 3)
    assert talks[8].begin - talks[1].end == pytest.approx(GAP)


def test_a_longer_gap_of_the_line_goes_before_it() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(request_gap=0.5))
    bus.servers(devices(1))
    master.session.set_unit_gaps({1: GAP})
    master.get(1, READ)
    master.get(1, READ)
    talks = bus.line.transmissions()
    assert talks[2].begin - talks[1].end == pytest.approx(0.5)


def test_a_new_connection_owes_no_unit_a_gap() -> None:
    bus = Bus()
    master = bus.master()
    bus.servers(devices(1))
    master.session.set_unit_gaps({1: 60.0})
    master.get(1, READ)
    master.session.disconnected(bus.now, "unplugged")
    master.session.connected(bus.now)
    began = bus.now
    master.get(1, READ)
    assert bus.now - began < 1.0
