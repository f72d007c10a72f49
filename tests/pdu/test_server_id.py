"""The parts of what function 17 reads."""

import pytest

import busway
from busway import ServerId


@pytest.mark.parametrize(
    ("data", "parts"),
    [
        (b"pump\xff", ServerId(b"pump", True, b"")),
        (b"pump\x00v1.2", ServerId(b"pump", False, b"v1.2")),
        (b"pump", ServerId(b"pump", None, b"")),
        (b"", ServerId(b"", None, b"")),
        (b"\xff\x00", ServerId(b"", True, b"\x00")),
    ],
)
def test_identification_ends_at_the_first_run_indicator(data: bytes, parts: ServerId) -> None:
    assert ServerId.of(data) == parts


def test_the_server_id_of_our_own_server() -> None:
    with (
        busway.serve_in_thread("tcp://127.0.0.1:0", units={1: busway.Device(server_id=b"pump\xff")}) as server,
        busway.connect(server.endpoints[0]) as link,
    ):
        assert ServerId.of(link.unit(1).report_server_id()) == ServerId(b"pump", True, b"")
