"""What a server says when it starts where the network can reach it."""

import logging
from pathlib import Path

import pytest

import busway
from busway.access.rules import Policy
from busway.apps.gateway.configuration import simple_gateway
from busway.server.bound_sockets import is_everywhere, is_loopback
from busway.server.exposure import warn_of_exposure


@pytest.fixture
def said(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.WARNING, "busway.server")
    return caplog


@pytest.mark.parametrize(
    ("url", "loopback", "everywhere"),
    [
        ("tcp://127.0.0.1:502", True, False),
        ("tcp://127.9.9.9:502", True, False),
        ("tcp://[::1]:502", True, False),
        ("udp://0.0.0.0:502", False, True),
        ("tcp://[::]:502", False, True),
        ("tcp://10.0.0.5:502", False, False),
        ("tcp://[fe80::1%eth0]:502", False, False),
    ],
)
def test_who_can_reach_a_bound_address(url: str, loopback: bool, everywhere: bool) -> None:
    assert (is_loopback(url), is_everywhere(url)) == (loopback, everywhere)


@pytest.mark.clause("T20")
async def test_every_address_is_taken_and_warned_of(said: pytest.LogCaptureFixture) -> None:
    units = busway.Device(holding_registers=[7])
    async with busway.serve("tcp://0.0.0.0:0", units=units, policy=Policy.read_only()) as server:
        port = server.endpoints[0].rpartition(":")[2]
        async with busway.open(f"tcp://127.0.0.1:{port}") as link:
            assert await link.unit(1).read_holding_registers(0, count=1) == [7]
    (line,) = said.messages
    assert line == f"tcp://0.0.0.0:{port}: every address of this host; name one to listen there alone"


def test_a_server_that_the_network_can_write_to_says_so_once_and_how_to_change_it(
    said: pytest.LogCaptureFixture,
) -> None:
    warn_of_exposure(["tcp://10.0.0.5:502", "udp://10.0.0.5:502", "rtu:///dev/ttyS0"], authorized=False)
    (line,) = said.messages
    assert line.startswith("tcp://10.0.0.5:502, udp://10.0.0.5:502: takes writes from every host")
    assert "policy=busway.Policy.read_only()" in line


async def test_on_loopback_on_a_line_and_behind_a_policy_nothing_is_said(said: pytest.LogCaptureFixture) -> None:
    warn_of_exposure(["tcp://127.0.0.1:502", "rtu:///dev/ttyS0"], authorized=False)
    warn_of_exposure(["tcp://10.0.0.5:502"], authorized=True)
    async with busway.serve("tcp://127.0.0.1:0", units=busway.Device(coils=1)):
        pass
    assert said.messages == []


async def test_an_audit_log_alone_is_no_policy(said: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    with busway.AuditLog(tmp_path / "audit.jsonl") as log:
        async with busway.serve("tcp://0.0.0.0:0", units=busway.Device(coils=1), audit=log, standard_port=False):
            pass
        assert any("takes writes from every host" in line for line in said.messages)
        said.clear()
        everything = Policy.allow_all()
        listener = "tcp://0.0.0.0:0"
        async with busway.serve(listener, units=busway.Device(coils=1), audit=log, policy=everything):
            pass
        assert not any("takes writes from every host" in line for line in said.messages)


async def test_a_gateway_with_an_audit_log_alone_says_that_it_takes_writes(
    said: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    configuration = simple_gateway(["tcp://0.0.0.0:0"], "tcp://127.0.0.1:1")
    with busway.AuditLog(tmp_path / "audit.jsonl") as log:
        async with configuration.serve(audit=log):
            pass
        assert any("takes writes from every host" in line for line in said.messages)
        said.clear()
        async with configuration.serve(audit=log, policy=Policy.read_only()):
            pass
        assert not any("takes writes from every host" in line for line in said.messages)


async def test_a_policy_stands_before_the_devices_and_can_be_replaced_while_it_serves() -> None:
    device = busway.Device(holding_registers=[7])
    async with (
        busway.serve("tcp://127.0.0.1:0", units=device, policy=Policy.read_only()) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        unit = link.unit(1)
        assert await unit.read_holding_registers(0, count=1) == [7]
        with pytest.raises(busway.ExceptionReply) as caught:
            await unit.write_single_register(0, 9)
        assert caught.value.code == busway.ExceptionCode.ILLEGAL_FUNCTION
        server.replace_policy(Policy())
        with pytest.raises(busway.ExceptionReply):
            await unit.read_holding_registers(0, count=1)
    assert device.holding_registers[0] == 7
    with pytest.raises(busway.ConfigError, match="without a policy"):
        busway.serve("tcp://127.0.0.1:0", units=device).replace_policy(Policy())
