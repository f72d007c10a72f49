"""A network of hosts for each test, where this system lets one be made."""

import os
import shutil
from collections.abc import Iterator

import pytest
from hosts import Network, why_not


@pytest.fixture(scope="session")
def _possible() -> None:
    """Skip with the reason; where every program has to be there, a missing one is a failure."""
    if os.environ.get("BUSWAY_REQUIRE_PEERS") == "1" and os.geteuid() == 0:
        assert shutil.which("ip"), "there is no ip command (Debian: iproute2)"
    if reason := why_not():
        pytest.skip(reason)


@pytest.fixture
def network(_possible: None) -> Iterator[Network]:
    with Network() as network:
        yield network
