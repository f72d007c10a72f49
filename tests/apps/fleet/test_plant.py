"""What a collector of a fleet makes of a plant's configuration."""

from pathlib import Path

import pytest
from fleet_devices import FleetDevice, plant

from busway.apps.collector.configuration import parse_collector
from busway.apps.fleet.plant import longest_transaction, with_short_user_timeout


@pytest.mark.parametrize(
    ("url", "more", "longest"),
    [
        ("tcp://127.0.0.1:502", "timeout = 2", 5.0),
        ("tcp://127.0.0.1:502?user_timeout=20", "timeout = 2", 5.0),
        ("tcp://127.0.0.1:502", "timeout = 2\nuser_timeout = 1", 5.0),
        ("rtu+tcp://127.0.0.1:502", "timeout = 2\nconnect_timeout = 1", 3.0),
        ("udp://127.0.0.1:502", "timeout = 2", 5.0),
        ("rtu:///dev/ttyUSB0", "timeout = 2", 2.0),
    ],
)
def test_the_system_repeats_no_request_for_longer_than_the_transaction_may_take(
    tmp_path: Path, url: str, more: str, longest: float
) -> None:
    text = plant(tmp_path / "store", [FleetDevice("hall", 502)], more).replace("tcp://127.0.0.1:502", url)
    configuration = with_short_user_timeout(parse_collector(text, "x.toml"))
    assert longest_transaction(configuration, "hall") == longest
