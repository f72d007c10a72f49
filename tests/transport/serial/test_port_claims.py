"""A serial port has one user in a process."""

import os
from pathlib import Path

import pytest

from busway.errors import ConfigError
from busway.transport.serial.port_claims import PortClaim


@pytest.mark.clause("S15")
def test_claimed_port_is_refused_to_the_next_and_names_its_user() -> None:
    claim = PortClaim("/dev/ttyNONE", "a test")
    with pytest.raises(ConfigError, match=r"/dev/ttyNONE is in use in this process already, by a test"):
        PortClaim("/dev/ttyNONE", "another")
    claim.release()
    claim.release()
    PortClaim("/dev/ttyNONE", "another").release()


@pytest.mark.clause("S15")
def test_claim_is_of_the_device_whatever_link_leads_to_it(tmp_path: Path) -> None:
    device, link = tmp_path / "device", tmp_path / "by-id"
    device.touch()
    os.symlink(device, link)
    claim = PortClaim(str(device), "a test")
    with pytest.raises(ConfigError, match="in use"):
        PortClaim(str(link), "another")
    claim.release()


def test_claim_ends_with_its_holder() -> None:
    claim = PortClaim("/dev/ttyNONE", "a test")
    del claim
    PortClaim("/dev/ttyNONE", "another").release()
