"""How a port is opened and waited at, and that it has one user in a process."""

import os
from pathlib import Path

import pytest

from busway.errors import ConfigError
from busway.options.ports import OpeningParameters
from busway.transport.serial.opening import Claim, reopen_policy


@pytest.mark.clause("S15")
def test_claimed_port_is_refused_to_the_next_and_names_its_user() -> None:
    claim = Claim("/dev/ttyNONE", "a test")
    with pytest.raises(ConfigError, match=r"/dev/ttyNONE is in use in this process already, by a test"):
        Claim("/dev/ttyNONE", "another")
    claim.release()
    claim.release()
    Claim("/dev/ttyNONE", "another").release()


@pytest.mark.clause("S15")
def test_claim_is_of_the_device_whatever_link_leads_to_it(tmp_path: Path) -> None:
    device, link = tmp_path / "device", tmp_path / "by-id"
    device.touch()
    os.symlink(device, link)
    claim = Claim(str(device), "a test")
    with pytest.raises(ConfigError, match="in use"):
        Claim(str(link), "another")
    claim.release()


def test_claim_ends_with_its_holder() -> None:
    claim = Claim("/dev/ttyNONE", "a test")
    del claim
    Claim("/dev/ttyNONE", "another").release()


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"port_wait": -1.0}, "port_wait"),
        ({"reopen_first": 0.0}, "reopen_first"),
        ({"reopen_first": 3.0, "reopen_most": 2.0}, "reopen_most"),
    ],
)
def test_impossible_settings_are_refused_under_their_own_names(options: dict[str, float], key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        OpeningParameters(**options)  # type: ignore[arg-type]
    assert caught.value.key == key


def test_pauses_double_up_to_the_longest() -> None:
    policy = reopen_policy(OpeningParameters(reopen_first=0.1, reopen_most=0.3))
    assert [policy.pause(failures) for failures in (1, 2, 3, 50)] == pytest.approx([0.1, 0.2, 0.3, 0.3])
