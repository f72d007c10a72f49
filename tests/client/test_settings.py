"""What a link is set to where nothing is said."""

import pytest

from busway.client.settings import link_settings


@pytest.mark.parametrize(
    ("url", "timeout"),
    [
        ("tcp://10.0.0.5", 3.0),
        ("tls://10.0.0.5", 3.0),
        ("udp://10.0.0.5", 3.0),
        ("rtu:///dev/ttyX", 1.0),
        ("ascii:///dev/ttyX", 1.0),
        ("rtu+tcp://10.0.0.5:4001", 1.0),
        ("tcp://10.0.0.5?timeout=1", 1.0),
    ],
)
def test_a_client_waits_for_a_gateway_longer_than_for_a_unit_on_a_line(url: str, timeout: float) -> None:
    assert link_settings(url, {}).parameters.timeout == timeout


def test_an_option_goes_before_the_default_of_the_scheme() -> None:
    assert link_settings("tcp://10.0.0.5", {"timeout": 0.5}).parameters.timeout == 0.5
