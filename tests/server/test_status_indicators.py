"""The three status indicators of a listener."""

import pytest

from busway.server.status_indicators import Diagnosis, StatusIndicator


@pytest.mark.clause("S19")
def test_communication_shows_for_half_a_second() -> None:
    diagnosis = Diagnosis()
    diagnosis.is_open = True
    assert diagnosis.indicators(10.0).communication is StatusIndicator.OFF
    diagnosis.traffic = 10.0
    assert diagnosis.indicators(10.4).communication is StatusIndicator.ON
    assert diagnosis.indicators(10.6).communication is StatusIndicator.OFF


@pytest.mark.clause("S19")
def test_internal_fault_is_steady_and_communication_fault_flashes() -> None:
    diagnosis = Diagnosis()
    diagnosis.is_open = True
    assert diagnosis.indicators(10.0).error is StatusIndicator.OFF
    diagnosis.communication_fault = 10.0
    assert diagnosis.indicators(12.0).error is StatusIndicator.FLASHING
    diagnosis.internal_fault = 11.0
    assert diagnosis.indicators(12.0).error is StatusIndicator.ON
    assert diagnosis.indicators(22.0).error is StatusIndicator.OFF


@pytest.mark.clause("S19")
def test_port_that_is_not_there_flashes_as_long_as_it_is_not() -> None:
    diagnosis = Diagnosis()
    indicators = diagnosis.indicators(1000.0)
    assert (indicators.error, indicators.device_status) == (StatusIndicator.FLASHING, StatusIndicator.OFF)


@pytest.mark.clause("S19")
def test_device_status_is_on_when_it_answers_and_flashes_in_listen_only_mode() -> None:
    diagnosis = Diagnosis()
    diagnosis.is_open = True
    assert diagnosis.indicators(0.0).device_status is StatusIndicator.ON
    assert diagnosis.indicators(0.0, listen_only=True).device_status is StatusIndicator.FLASHING
