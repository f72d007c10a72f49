"""Errors name an interface or local address that cannot be used; failures with other causes keep their words."""

import errno
import socket

import pytest

from busway.transport.local_end import connect_failure, interface_problem


def reason(error: BaseException, *, host: str = "127.0.0.1", local: str | None = None, by: str | None = None) -> str:
    return connect_failure(error, endpoint="tcp://x", host=host, local_address=local, interface=by).message


def test_a_failure_that_has_another_cause_keeps_its_words_and_kind() -> None:
    refused = ConnectionRefusedError(errno.ECONNREFUSED, "refused")
    down = connect_failure(
        refused, endpoint="tcp://x", host="127.0.0.1", local_address="127.0.0.1", interface=socket.if_nameindex()[0][1]
    )
    assert (down.kind, down.message) == ("refused", "no connection: nothing listens there (connection refused)")
    assert down.__cause__ is refused
    assert "nothing listens there" in reason(refused, local="a-name-of-this-host")


def test_a_host_name_beside_a_numeric_local_address_is_what_cannot_be_resolved() -> None:
    unknown = socket.gaierror(socket.EAI_NONAME, "Name or service not known")
    assert reason(unknown, host="no.example", local="127.0.0.1") == (
        "no connection: the host name cannot be resolved (Name or service not known)"
    )


def test_where_host_and_local_address_are_names_both_are_named() -> None:
    unknown = socket.gaierror(socket.EAI_NONAME, "Name or service not known")
    assert "local_address: 'eth0', or the host 'no.example', cannot be resolved" in reason(
        unknown, host="no.example", local="eth0"
    )


def test_an_interface_that_the_system_does_not_allow_is_named() -> None:
    name = socket.if_nameindex()[0][1]
    assert f"interface: the system does not let this program use {name!r}" in reason(
        PermissionError(errno.EPERM, "not permitted"), by=name
    )


def test_of_many_interfaces_the_first_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "if_nameindex", lambda: [(n, f"veth{n}") for n in range(300)])
    problem = interface_problem(OSError(errno.ENODEV, "No such device"), "eth9")
    assert problem.endswith("which has veth0, veth1, veth2, veth3, veth4, veth5, veth6, veth7…")
